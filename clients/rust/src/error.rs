//! Errors of the client.

use std::path::PathBuf;

use twinstep_protocol::ErrorReply;

/// Reasons why a request fails.
#[derive(Debug, thiserror::Error)]
pub enum ClientError {
    /// The program was interrupted while a robot was not ready.
    #[error("interrupted while the robot was not ready: {reason}")]
    Interrupted {
        /// What the robot waits for.
        reason: String,
    },
    /// The server process could not be started.
    #[error("the server process did not start: {0}")]
    ServerStart(String),
    /// Zenoh rejects the configuration.
    #[error(
        "Zenoh configuration{}: {reason}",
        path.as_ref().map(|path| format!(" {}", path.display())).unwrap_or_default()
    )]
    Config {
        /// The file, if there is one.
        path: Option<PathBuf>,
        /// Error of Zenoh.
        reason: String,
    },
    /// No connection could be opened.
    #[error("no server answers at {endpoint} after {waited_s:.1} s ({reason})\n  {}", connect_reason(*reachability))]
    NoServer {
        /// Endpoint of the server or router.
        endpoint: String,
        /// Time until the request failed [s].
        waited_s: f64,
        /// Error of Zenoh.
        reason: String,
        /// How far a connection comes.
        reachability: Reachability,
    },
    /// The connection works, but no server is visible.
    #[error(
        "connected to {endpoint}, but no server is visible there after {waited_s:.1} s\n  either no server is running, \
         or access control hides it from this user: Zenoh does not report which\n  read the log of the server: \
         `TWINSTEP_LOG={SERVER_LOG} twinstep serve --zenoh FILE`\n  its `access_control` must allow this user what \
         `examples/security/server-acl.json5` allows `alice`"
    )]
    NoServerVisible {
        /// Endpoint of the connection.
        endpoint: String,
        /// Duration of the discovery [s].
        waited_s: f64,
    },
    /// A server is visible, but sends no scene of its robots.
    #[error(
        "`{robot}` has sent no scene of its robots for {waited_s:.1} s\n  either its program cannot show them (`twinstep \
         serve` and `twinstep robot` can), or access control hides them from this user: it needs what \
         `examples/security/server-acl.json5` allows `alice`"
    )]
    NoScene {
        /// Name of the robot.
        robot: String,
        /// Time until the request failed [s].
        waited_s: f64,
    },
    /// Servers are visible, but none or several match.
    #[error("{expected}; visible: {}\n  set `robot` to the name of one of them", visible.join(", "))]
    AmbiguousRobot {
        /// The requested robot, and the number of matches.
        expected: String,
        /// `name (sid)` of every visible server.
        visible: Vec<String>,
    },
    /// The environments cannot be divided like this.
    #[error("`groups` = {groups} is not allowed: 1 to {num_envs}, the number of environments")]
    Groups {
        /// Number of groups.
        groups: usize,
        /// Number of environments.
        num_envs: usize,
    },
    /// The environments cannot be divided among these servers.
    #[error("{servers} servers are given for {num_envs} environments\n  give 1 server to one for each environment")]
    Servers {
        /// Number of servers.
        servers: usize,
        /// Number of environments.
        num_envs: usize,
    },
    /// Two servers have different environments.
    #[error(
        "the servers at {} and {} have different specs: tasks, rewards, gains and episode lengths must be equal",
        endpoints[0], endpoints[1]
    )]
    OtherSpec {
        /// Endpoints of the servers.
        endpoints: [String; 2],
    },
    /// No server of several is left.
    #[error(
        "all servers are lost, and none has granted a lease for {waited_s:.1} s\n  check that one of them is running and \
         has free environments"
    )]
    NoServerLeft {
        /// Time until the request failed [s].
        waited_s: f64,
    },
    /// The request is larger than the server accepts. It was not sent.
    #[error("`{request}` has {bytes} bytes; the server accepts at most {limit}\n  it hosts fewer environments")]
    TooLarge {
        /// Key of the request.
        request: String,
        /// Its size [bytes].
        bytes: usize,
        /// The server's limit [bytes].
        limit: usize,
    },
    /// The server does not support the client's protocol version.
    #[error(
        "the server supports protocol {} to {}, this client {ours}\n  install the same Twinstep at both ends",
        theirs[0], theirs[1]
    )]
    Version {
        /// Lowest and highest version that the server supports.
        theirs: [u16; 2],
        /// Version of the client.
        ours: u16,
    },
    /// The server rejected the request.
    #[error(transparent)]
    Rejected(#[from] ErrorReply),
    /// The server is shutting down.
    #[error("the server at {endpoint} is shutting down; the request was not executed")]
    ShuttingDown {
        /// Endpoint of the server.
        endpoint: String,
    },
    /// The server was restarted: the environments of its leases are lost.
    #[error(
        "the server at {endpoint} was restarted: the environments of this lease are lost\n  connect again and reset"
    )]
    Restarted {
        /// Endpoint of the server.
        endpoint: String,
    },
    /// No reply arrived in time.
    #[error("no reply from {endpoint} to `{request}` after {waited_s:.1} s: {reason}")]
    RequestTimeout {
        /// Endpoint of the server.
        endpoint: String,
        /// The request.
        request: String,
        /// Time until the request failed [s].
        waited_s: f64,
        /// The reason, and what to do.
        reason: String,
    },
    /// The last request is in progress and may have been executed. No other request can be sent before its reply.
    #[error("the last `{0}` has no reply yet\n  call `recv` to wait for it, or `reset` to wait and start new episodes")]
    RequestPending(&'static str),
    /// `recv` was called without `send`.
    #[error("no request is in progress: call `send` before `recv`")]
    NothingSent,
    /// The reply does not conform to the protocol.
    #[error("the server's reply to `{request}` is malformed: {reason}")]
    Malformed {
        /// The request.
        request: String,
        /// What is wrong with the reply.
        reason: String,
    },
    /// An earlier reply could not be read, so the state of the environments is unknown.
    #[error(
        "the state of the environments is unknown, because a reply could not be read\n  call `reset` without a mask to continue"
    )]
    UnknownState,
}

/// Value of `TWINSTEP_LOG` with which a server logs each rejected client and the reason.
const SERVER_LOG: &str = "warn,twinstep=info,zenoh_transport=debug,zenoh::net::routing=info";

/// How far a connection to an endpoint comes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Reachability {
    /// A program accepts connections.
    Open,
    /// No program does.
    Closed,
    /// The name of the host is unknown.
    UnknownHost,
    /// The endpoint has no port.
    NoPort,
}

fn connect_reason(reachability: Reachability) -> String {
    let text = match reachability {
        Reachability::UnknownHost => "the name of the host is unknown: check its spelling, or use its address",
        Reachability::NoPort => "the endpoint has no port: tcp/HOST:PORT, such as tcp/127.0.0.1:7447",
        Reachability::Closed => {
            "no program accepts connections there: start a server with `twinstep serve --listen ENDPOINT`, or check the address, \
             the port and the firewall"
        }
        Reachability::Open => {
            return format!(
                "a program accepts connections there: either it is not a Zenoh server, or it rejects this client: its user, \
                 password or certificate, or tcp instead of tls; Zenoh does not report which\n  read the log of the server: \
                 `TWINSTEP_LOG={SERVER_LOG} twinstep serve --zenoh FILE`"
            );
        }
    };
    text.to_owned()
}
