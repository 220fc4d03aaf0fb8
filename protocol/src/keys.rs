//! Key expressions of requests and liveliness tokens.
//!
//! The server id `<sid>` is new at each start of a server, so no two queryables share a key.

/// First segment of every key.
pub const ROOT: &str = "twinstep";

/// Returns the key expression of all requests to the server `sid`.
pub fn server(sid: &str) -> String {
    format!("{ROOT}/{sid}/**")
}

/// Returns the key of `hello`: identity of the server and what it hosts.
pub fn hello(sid: &str) -> String {
    format!("{ROOT}/{sid}/hello")
}

/// Returns the key that leases environments.
pub fn lease(sid: &str) -> String {
    format!("{ROOT}/{sid}/lease")
}

/// Returns the key that stops a robot.
pub fn stop(sid: &str) -> String {
    format!("{ROOT}/{sid}/stop")
}

/// Returns the key at which a server publishes what stays the same in every frame of its robots.
pub fn scene(sid: &str) -> String {
    format!("{ROOT}/{sid}/view/scene")
}

/// Returns the key at which a server publishes frames of its robots.
pub fn frame(sid: &str) -> String {
    format!("{ROOT}/{sid}/view/frame")
}

/// Returns the key of a method of the environments of `lease`.
pub fn env(sid: &str, lease: &str, verb: EnvMethod) -> String {
    format!("{ROOT}/{sid}/env/{lease}/{}", verb.name())
}

/// Returns the key of the liveliness token of the server `sid` with the robot name `name`.
pub fn live_server(sid: &str, name: &str) -> String {
    format!("{ROOT}/live/server/{sid}/{name}")
}

/// Key expression of the liveliness tokens of all servers.
pub const LIVE_SERVERS: &str = "twinstep/live/server/*/*";

/// Returns the key of the liveliness token of the client `client` at the server `sid`.
pub fn live_client(sid: &str, client: &str) -> String {
    format!("{ROOT}/live/client/{sid}/{client}")
}

/// Returns the key expression of the liveliness tokens of all clients of the server `sid`.
pub fn live_clients(sid: &str) -> String {
    format!("{ROOT}/live/client/{sid}/*")
}

/// Method of the environments of a lease.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum EnvMethod {
    /// Starts new episodes.
    Reset,
    /// Advances all environments by one policy period.
    Step,
    /// Runs a policy on the server for several policy periods.
    Rollout,
    /// Ends the lease.
    Close,
    /// Returns the scene of one environment. Only reads, so it has no sequence number.
    Render,
    /// Returns the samples of one environment in the last step. It has no sequence number.
    Samples,
}

impl EnvMethod {
    /// All methods.
    pub const ALL: [EnvMethod; 6] = [
        EnvMethod::Reset,
        EnvMethod::Step,
        EnvMethod::Rollout,
        EnvMethod::Close,
        EnvMethod::Render,
        EnvMethod::Samples,
    ];

    /// Returns the last segment of the method's key.
    pub const fn name(self) -> &'static str {
        match self {
            EnvMethod::Reset => "reset",
            EnvMethod::Step => "step",
            EnvMethod::Rollout => "rollout",
            EnvMethod::Close => "close",
            EnvMethod::Render => "render",
            EnvMethod::Samples => "samples",
        }
    }
}

/// Request that a key of a server stands for.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Request<'a> {
    /// [`hello`].
    Hello,
    /// [`lease`].
    Lease,
    /// [`stop`].
    Stop,
    /// [`env`].
    Env {
        /// Id of the lease.
        lease: &'a str,
        /// Method of its environments.
        verb: EnvMethod,
    },
}

/// Returns the request that `key` stands for at the server `sid`, or `None` if the key does not exist.
pub fn parse<'a>(key: &'a str, sid: &str) -> Option<Request<'a>> {
    let rest = key.strip_prefix(ROOT)?.strip_prefix('/')?.strip_prefix(sid)?.strip_prefix('/')?;
    match rest.split('/').collect::<Vec<_>>()[..] {
        ["hello"] => Some(Request::Hello),
        ["lease"] => Some(Request::Lease),
        ["stop"] => Some(Request::Stop),
        ["env", lease, verb] => {
            let verb = EnvMethod::ALL.into_iter().find(|known| known.name() == verb)?;
            Some(Request::Env { lease, verb })
        }
        _ => None,
    }
}

/// Returns the server id and the robot name in the key of a server's liveliness token.
pub fn parse_live_server(key: &str) -> Option<(&str, &str)> {
    key.strip_prefix("twinstep/live/server/")?.split_once('/')
}

/// Returns the client id in the key of a client's liveliness token at the server `sid`.
pub fn parse_live_client<'a>(key: &'a str, sid: &str) -> Option<&'a str> {
    key.strip_prefix("twinstep/live/client/")?.strip_prefix(sid)?.strip_prefix('/')
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parsing_inverts_formatting() {
        assert_eq!(parse(&hello("a1"), "a1"), Some(Request::Hello));
        assert_eq!(parse(&lease("a1"), "a1"), Some(Request::Lease));
        assert_eq!(parse(&stop("a1"), "a1"), Some(Request::Stop));
        for verb in EnvMethod::ALL {
            assert_eq!(parse(&env("a1", "77", verb), "a1"), Some(Request::Env { lease: "77", verb }));
        }
        assert_eq!(parse_live_server(&live_server("a1", "go2")), Some(("a1", "go2")));
        assert_eq!(parse_live_client(&live_client("a1", "c9"), "a1"), Some("c9"));
    }

    #[test]
    fn unknown_keys_are_none() {
        for key in ["twinstep/a1", "twinstep/a1/", "twinstep/b2/hello", "twinstep/a1/env/7", "twinstep/a1/env/7/jump"] {
            assert_eq!(parse(key, "a1"), None, "{key}");
        }
    }
}
