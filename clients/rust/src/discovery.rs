//! Servers that are visible at an endpoint, and the choice of one.

use std::time::{Duration, Instant};

use twinstep_protocol::message::{HelloReply, HelloRequest};
use twinstep_protocol::{PROTOCOL, decode, encode, keys};
use zenoh::query::{ConsolidationMode, QueryTarget};
use zenoh::{Session, Wait};

use crate::{ClientError, ConnectOptions, session};

/// Time in which a server answers `hello`.
const HELLO_TIMEOUT: Duration = Duration::from_secs(2);
/// Time without an answer after which a visible server counts as gone. A router needs a moment to find the way to it.
const GONE: Duration = Duration::from_secs(1);
/// Pause between two looks at the visible servers.
const POLL_PERIOD: Duration = Duration::from_millis(50);

/// A server that is visible at an endpoint.
#[derive(Clone, Debug, PartialEq)]
pub struct ServerInfo {
    /// Id of the server, new at every start.
    pub server_id: String,
    /// Name of the robot, for [`ConnectOptions::robot`].
    pub robot: String,
    /// What the server says of itself. `None` if it does not answer: it may be suspended or disconnected, or access
    /// control may deny requests to this user.
    pub hello: Option<HelloReply>,
}

/// Session with which the visible servers are listed again and again.
pub struct Discovery(Session);

impl Discovery {
    /// Connects to `options.endpoint`. `robot` and `num_envs` are not used.
    pub fn open(options: &ConnectOptions) -> Result<Self, ClientError> {
        session::open(options).map(Self)
    }

    /// Returns the visible servers, sorted by robot and id.
    pub fn servers(&self) -> Vec<ServerInfo> {
        with_hellos(&self.0, visible_servers(&self.0))
    }
}

/// Returns the server id and the robot name of every visible server.
pub fn visible_servers(session: &Session) -> Vec<(String, String)> {
    let Ok(replies) = session.liveliness().get(keys::LIVE_SERVERS).timeout(HELLO_TIMEOUT).wait() else {
        return Vec::new();
    };
    let mut servers: Vec<(String, String)> = std::iter::from_fn(|| replies.recv().ok())
        .filter_map(|reply| reply.into_result().ok())
        .filter_map(|sample| {
            let (sid, name) = keys::parse_live_server(sample.key_expr().as_str())?;
            Some((sid.to_owned(), name.to_owned()))
        })
        .collect();
    servers.sort();
    servers.dedup();
    servers
}

/// Sends `hello` to all servers at once and returns their replies.
fn with_hellos(session: &Session, servers: Vec<(String, String)>) -> Vec<ServerInfo> {
    let request = encode(&HelloRequest { protocol: PROTOCOL, client: String::new() });
    let ask = |sid: &str| {
        let query = session.get(keys::hello(sid)).payload(request.clone()).timeout(HELLO_TIMEOUT);
        query.target(QueryTarget::BestMatching).consolidation(ConsolidationMode::None).wait().ok()
    };
    let asked: Vec<_> = servers.into_iter().map(|(server_id, robot)| (ask(&server_id), server_id, robot)).collect();
    let mut found: Vec<ServerInfo> = asked
        .into_iter()
        .map(|(replies, server_id, robot)| {
            let sample = replies.and_then(|replies| replies.recv().ok()?.into_result().ok());
            let hello = sample.and_then(|sample| decode(&sample.payload().to_bytes()).ok());
            ServerInfo { server_id, robot, hello }
        })
        .collect();
    found.sort_by(|a, b| (&a.robot, &a.server_id).cmp(&(&b.robot, &b.server_id)));
    found
}

/// Returns the id and the robot of the server to connect to.
///
/// Among several servers with the same robot, task and layout it is the one with the most free environments.
pub fn choose_server(session: &Session, options: &ConnectOptions) -> Result<(String, String), ClientError> {
    let since = Instant::now();
    loop {
        let visible = visible_servers(session);
        let is_requested = |(id, name): &&(String, String)| {
            options.robot.as_ref().is_none_or(|robot| robot == name)
                && options.server_id.as_ref().is_none_or(|server| server == id)
        };
        let matching: Vec<_> = visible.iter().filter(is_requested).cloned().collect();
        if let [only] = &matching[..] {
            return Ok(only.clone());
        }
        let mut servers = with_hellos(session, matching.clone());
        if since.elapsed() >= GONE {
            servers.retain(|server| server.hello.is_some());
        }
        if let Some(server) = most_free(servers) {
            return Ok((server.server_id, server.robot));
        }
        if since.elapsed() >= options.connect_timeout {
            return Err(no_choice(options, &visible, matching.len(), since.elapsed()));
        }
        // The token of a server that starts or has ended may be visible a moment later or longer.
        std::thread::sleep(POLL_PERIOD);
    }
}

/// Returns the server with the most free environments. `None` if they differ in robot, task or layout, or one does not answer.
fn most_free(servers: Vec<ServerInfo>) -> Option<ServerInfo> {
    let kind = |server: &ServerInfo| {
        let hello = server.hello.as_ref()?;
        Some((server.robot.clone(), hello.spec.task.clone(), hello.spec_hash.clone()))
    };
    let first = kind(servers.first()?)?;
    let all_alike = servers.iter().all(|server| kind(server).as_ref() == Some(&first));
    let free = |server: &ServerInfo| server.hello.as_ref().map_or(0, |hello| hello.free_envs);
    servers.into_iter().filter(|_| all_alike).max_by_key(free)
}

fn no_choice(options: &ConnectOptions, visible: &[(String, String)], matching: usize, waited: Duration) -> ClientError {
    if visible.is_empty() {
        return ClientError::NoServerVisible { endpoint: options.endpoint.clone(), waited_s: waited.as_secs_f64() };
    }
    let expected = match &options.robot {
        Some(robot) => format!("{matching} robots have the name `{robot}`, and differ in task or layout"),
        None => format!("{matching} robots are visible, and `robot` is not set"),
    };
    let visible = visible.iter().map(|(sid, name)| format!("{name} ({sid})")).collect();
    ClientError::AmbiguousRobot { expected, visible }
}
