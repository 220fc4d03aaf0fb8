//! Key expressions.
//!
//! `<sid>` names one start of one server, so that no two queryables ever share a key.

/// First part of every key.
pub const ROOT: &str = "twinstep";

/// Everything that the server `sid` answers.
pub fn server(sid: &str) -> String {
    format!("{ROOT}/{sid}/**")
}

/// Who the server is and what it hosts.
pub fn hello(sid: &str) -> String {
    format!("{ROOT}/{sid}/hello")
}

/// Asks for environments.
pub fn lease(sid: &str) -> String {
    format!("{ROOT}/{sid}/lease")
}

/// Asks the environments of `lease` to do something.
pub fn env(sid: &str, lease: &str, verb: EnvMethod) -> String {
    format!("{ROOT}/{sid}/env/{lease}/{}", verb.name())
}

/// Liveliness token of the server `sid` with the robot name `name`.
pub fn live_server(sid: &str, name: &str) -> String {
    format!("{ROOT}/live/server/{sid}/{name}")
}

/// Selects the liveliness tokens of all servers.
pub const LIVE_SERVERS: &str = "twinstep/live/server/*/*";

/// Liveliness token of the client `client` at the server `sid`.
pub fn live_client(sid: &str, client: &str) -> String {
    format!("{ROOT}/live/client/{sid}/{client}")
}

/// Selects the liveliness tokens of all clients of the server `sid`.
pub fn live_clients(sid: &str) -> String {
    format!("{ROOT}/live/client/{sid}/*")
}

/// What the environments of a lease can be asked.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum EnvMethod {
    /// Start episodes anew.
    Reset,
    /// Advance one policy period.
    Step,
    /// Give the environments back.
    Close,
    /// Tell what it takes to draw one environment. Carries no sequence number.
    Render,
}

impl EnvMethod {
    /// Every verb.
    pub const ALL: [EnvMethod; 4] = [EnvMethod::Reset, EnvMethod::Step, EnvMethod::Close, EnvMethod::Render];

    /// The verb's last part of the key.
    pub const fn name(self) -> &'static str {
        match self {
            EnvMethod::Reset => "reset",
            EnvMethod::Step => "step",
            EnvMethod::Close => "close",
            EnvMethod::Render => "render",
        }
    }
}

/// What a query's key asks of the server `sid`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Request<'a> {
    /// [`hello`].
    Hello,
    /// [`lease`].
    Lease,
    /// [`env`].
    Env {
        /// The lease.
        lease: &'a str,
        /// What its environments are asked.
        verb: EnvMethod,
    },
}

/// What `key` asks of the server `sid`, or `None` if nothing is answered there.
pub fn parse<'a>(key: &'a str, sid: &str) -> Option<Request<'a>> {
    let rest = key.strip_prefix(ROOT)?.strip_prefix('/')?.strip_prefix(sid)?.strip_prefix('/')?;
    match rest.split('/').collect::<Vec<_>>()[..] {
        ["hello"] => Some(Request::Hello),
        ["lease"] => Some(Request::Lease),
        ["env", lease, verb] => {
            let verb = EnvMethod::ALL.into_iter().find(|known| known.name() == verb)?;
            Some(Request::Env { lease, verb })
        }
        _ => None,
    }
}

/// Server id and robot name of a server's liveliness token.
pub fn parse_live_server(key: &str) -> Option<(&str, &str)> {
    key.strip_prefix("twinstep/live/server/")?.split_once('/')
}

/// Client id of a client's liveliness token at the server `sid`.
pub fn parse_live_client<'a>(key: &'a str, sid: &str) -> Option<&'a str> {
    key.strip_prefix("twinstep/live/client/")?.strip_prefix(sid)?.strip_prefix('/')
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_are_read_as_they_are_written() {
        assert_eq!(parse(&hello("a1"), "a1"), Some(Request::Hello));
        assert_eq!(parse(&lease("a1"), "a1"), Some(Request::Lease));
        for verb in EnvMethod::ALL {
            assert_eq!(parse(&env("a1", "77", verb), "a1"), Some(Request::Env { lease: "77", verb }));
        }
        assert_eq!(parse_live_server(&live_server("a1", "go2")), Some(("a1", "go2")));
        assert_eq!(parse_live_client(&live_client("a1", "c9"), "a1"), Some("c9"));
    }

    #[test]
    fn foreign_keys_are_none() {
        for key in ["twinstep/a1", "twinstep/a1/", "twinstep/b2/hello", "twinstep/a1/env/7", "twinstep/a1/env/7/jump"] {
            assert_eq!(parse(key, "a1"), None, "{key}");
        }
    }
}
