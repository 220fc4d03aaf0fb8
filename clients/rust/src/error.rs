//! Why a client did not get what it asked for.

use std::path::PathBuf;

use twinstep_protocol::ErrorReply;

/// Why a client did not get what it asked for.
#[derive(Debug, thiserror::Error)]
pub enum ClientError {
    /// The Zenoh configuration was refused.
    #[error("the Zenoh configuration{}: {reason}", path.as_ref().map(|path| format!(" {}", path.display())).unwrap_or_default())]
    Config {
        /// The file, if there is one.
        path: Option<PathBuf>,
        /// What Zenoh said.
        reason: String,
    },
    /// No connection could be opened.
    #[error("no server answers at {endpoint} after {waited_s:.1} s ({reason})\n  {}", refused_or_absent(*port_open))]
    NoServer {
        /// Where the client tried.
        endpoint: String,
        /// For how long [s].
        waited_s: f64,
        /// What Zenoh said.
        reason: String,
        /// True if a program accepts connections there.
        port_open: bool,
    },
    /// The connection stands, but no server is visible.
    #[error(
        "connected to {endpoint}, but no server is visible there after {waited_s:.1} s\n  either none runs behind it, or \
         access control hides it from this user: Zenoh tells the client nothing of either\n  to find out, look at what the \
         server says: `TWINSTEP_LOG={SERVER_LOG} twinstep serve --zenoh FILE`; its `access_control` must allow this \
         user what `examples/security/server-acl.json5` allows `alice`"
    )]
    NoServerVisible {
        /// Where the client is connected.
        endpoint: String,
        /// For how long it looked [s].
        waited_s: f64,
    },
    /// Servers are visible, but none or several fit.
    #[error("{wanted}; visible: {}\n  choose one by its name (`robot`)", visible.join(", "))]
    AmbiguousRobot {
        /// What was looked for and how many there are.
        wanted: String,
        /// `name (sid)` of every server.
        visible: Vec<String>,
    },
    /// The server speaks other protocol versions.
    #[error("the server speaks protocol {}..={}, this client {ours}\n  install the same Twinstep on both ends", theirs[0], theirs[1])]
    Version {
        /// Lowest and highest version of the server.
        theirs: [u16; 2],
        /// The client's.
        ours: u16,
    },
    /// The server refused.
    #[error(transparent)]
    Rejected(#[from] ErrorReply),
    /// The server was stopped.
    #[error("the server at {endpoint} is shutting down; the request was not executed")]
    ShuttingDown {
        /// Where it was.
        endpoint: String,
    },
    /// Another start of the server answers in the old one's place: its environments are gone.
    #[error(
        "the server at {endpoint} was restarted: the environments of this lease are gone\n  connect anew and reset"
    )]
    Restarted {
        /// Where it is.
        endpoint: String,
    },
    /// No answer came, for a stated reason.
    #[error("no answer from {endpoint} to `{request}` after {waited_s:.1} s: {reason}")]
    RequestTimeout {
        /// Where the server is or was.
        endpoint: String,
        /// What was asked.
        request: String,
        /// For how long [s].
        waited_s: f64,
        /// Which of the possible reasons it is, and what to do.
        reason: String,
    },
    /// The last request may or may not have been executed: nothing else can be asked before it is settled.
    #[error("the last `{0}` is not answered yet\n  `recv` waits for it again; `reset` settles it and starts anew")]
    RequestPending(&'static str),
    /// Nothing was sent.
    #[error("nothing was sent: call `send` before `recv`")]
    NothingSent,
    /// The server's answer is not what the protocol says.
    #[error("the server's answer to `{request}` is malformed: {reason}")]
    Malformed {
        /// What was asked.
        request: String,
        /// What is wrong with the answer.
        reason: String,
    },
}

/// What makes a server log whom it refuses, and why.
const SERVER_LOG: &str = "warn,twinstep=info,zenoh_transport=debug,zenoh::net::routing=info";

fn refused_or_absent(port_open: bool) -> String {
    if !port_open {
        return "no program accepts connections there: start a server with `twinstep serve --listen ENDPOINT`, or look \
                for its address, port or firewall"
            .to_owned();
    }
    format!(
        "a program accepts connections there: either it is no Zenoh server, or this client is refused: its user, \
         password or certificate, or tcp in place of tls; Zenoh does not tell the client which\n  to find out, look at \
         what the server says: `TWINSTEP_LOG={SERVER_LOG} twinstep serve --zenoh FILE`"
    )
}
