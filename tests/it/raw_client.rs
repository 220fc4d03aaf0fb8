//! A client without the client library. It sends any bytes to any key and returns every reply.

use std::time::Duration;

use twinstep_model::AutoresetMode;
use twinstep_protocol::keys::EnvMethod;
use twinstep_protocol::message::{
    CloseRequest, HelloReply, HelloRequest, LeaseReply, LeaseRequest, Reclaim, ResetReply, ResetRequest, StepReply,
    StepRequest,
};
use twinstep_protocol::tensor::{self, as_bytes};
use twinstep_protocol::{ErrorReply, PROTOCOL, Secret, decode, encode, keys};
use zenoh::handlers::FifoChannelHandler;
use zenoh::liveliness::LivelinessToken;
use zenoh::query::{ConsolidationMode, QueryTarget, Reply};
use zenoh::{Session, Wait};

/// Payload of a successful reply, or the error reply.
pub type Answer = Result<Vec<u8>, ErrorReply>;

/// A Zenoh session with one server.
pub struct RawClient {
    session: Session,
    pub sid: String,
    pub client: String,
    /// Attached to every request.
    pub secret: Secret,
    token: Option<LivelinessToken>,
    pub query_timeout: Duration,
}

impl RawClient {
    /// Connects to the server `sid` and declares the client's liveliness token.
    pub fn connect(endpoint: &str, sid: &str, client: &str) -> Self {
        let mut this = Self::without_token(endpoint, sid, client);
        let key = keys::live_client(sid, client);
        this.token = Some(this.session.liveliness().declare_token(key).wait().unwrap());
        this
    }

    /// Connects to the only server at `endpoint` and declares the client's liveliness token.
    pub fn connect_to_only_server(endpoint: &str, client: &str) -> Self {
        let mut this = Self::without_token(endpoint, "", client);
        let replies = this.session.liveliness().get("twinstep/live/server/*/*").wait().unwrap();
        let reply = replies.recv().unwrap().into_result().unwrap();
        this.sid = reply.key_expr().as_str().split('/').nth(3).unwrap().to_owned();
        let key = keys::live_client(&this.sid, client);
        this.token = Some(this.session.liveliness().declare_token(key).wait().unwrap());
        this
    }

    /// Opens another lease's client in the session of `client`, with a secret of its own.
    pub fn with_own_secret(client: &Self) -> Self {
        let (session, sid, name) = (client.session.clone(), client.sid.clone(), client.client.clone());
        let (secret, query_timeout) = (Secret::random(), client.query_timeout);
        Self { session, sid, client: name, secret, token: None, query_timeout }
    }

    /// Connects to the server `sid` without a liveliness token.
    pub fn without_token(endpoint: &str, sid: &str, client: &str) -> Self {
        let mut config = zenoh::Config::default();
        let endpoints = format!("[\"{endpoint}\"]");
        for (key, value) in [
            ("mode", "\"client\""),
            ("connect/endpoints", endpoints.as_str()),
            ("scouting/multicast/enabled", "false"),
            ("transport/shared_memory/enabled", "false"),
        ] {
            config.insert_json5(key, value).unwrap();
        }
        let session = twinstep_session::open(config).unwrap();
        let (sid, client) = (sid.to_owned(), client.to_owned());
        Self { session, sid, client, secret: Secret::random(), token: None, query_timeout: Duration::from_secs(5) }
    }

    /// Closes the session without closing the lease, like a crashed client.
    pub fn vanish(self) {
        self.session.close().wait().unwrap();
    }

    /// Returns true if the liveliness token of `client` is visible.
    pub fn sees(&self, client: &str) -> bool {
        let key = keys::live_client(&self.sid, client);
        let replies = self.session.liveliness().get(key).timeout(self.query_timeout).wait().unwrap();
        replies.recv().is_ok()
    }

    /// Sends a query without waiting for its reply.
    pub fn send(&self, key: &str, payload: &[u8]) -> FifoChannelHandler<Reply> {
        self.session
            .get(key)
            .payload(payload)
            .attachment(self.secret.as_bytes())
            .target(QueryTarget::BestMatching)
            .consolidation(ConsolidationMode::None)
            .timeout(self.query_timeout)
            .wait()
            .unwrap()
    }

    /// Sends a query and returns its reply. Panics unless there is exactly one successful reply or typed error.
    pub fn ask(&self, key: &str, payload: &[u8]) -> Answer {
        only_reply(&self.send(key, payload), key)
    }

    pub fn hello(&self) -> HelloReply {
        let request = encode(&HelloRequest { protocol: PROTOCOL, client: String::new() });
        decode(&self.ask(&keys::hello(&self.sid), &request).unwrap()).unwrap()
    }

    pub fn lease_request(&self, num_envs: u64) -> LeaseRequest {
        LeaseRequest {
            protocol: PROTOCOL,
            client: self.client.clone(),
            num_envs,
            autoreset: AutoresetMode::NextStep,
            max_episode_steps: None,
            critic: false,
            spec_hash: None,
            reclaim: None,
        }
    }

    pub fn ask_lease(&self, request: &LeaseRequest) -> Result<LeaseReply, ErrorReply> {
        self.ask(&keys::lease(&self.sid), &encode(request)).map(|bytes| decode(&bytes).unwrap())
    }

    pub fn lease(&self, num_envs: u64) -> LeaseReply {
        self.ask_lease(&self.lease_request(num_envs)).unwrap()
    }

    /// Reclaims a lease. The client needs its secret.
    pub fn reclaim(&self, lease: &str, epoch: u64) -> Result<LeaseReply, ErrorReply> {
        let reclaim = Some(Reclaim { lease: lease.to_owned(), epoch });
        self.ask_lease(&LeaseRequest { reclaim, ..self.lease_request(1) })
    }

    pub fn ask_env(&self, lease: &LeaseReply, verb: EnvMethod, payload: &[u8]) -> Answer {
        self.ask(&keys::env(&self.sid, &lease.lease, verb), payload)
    }

    pub fn reset(&self, lease: &LeaseReply, seq: u64) -> Answer {
        self.ask_env(lease, EnvMethod::Reset, &reset_bytes(lease, seq))
    }

    pub fn step(&self, lease: &LeaseReply, seq: u64) -> Answer {
        self.ask_env(lease, EnvMethod::Step, &step_bytes(lease, seq))
    }

    pub fn close(&self, lease: &LeaseReply, seq: u64) -> Answer {
        self.ask_env(lease, EnvMethod::Close, &encode(&CloseRequest { protocol: PROTOCOL, epoch: lease.epoch, seq }))
    }
}

/// Returns the only reply to a query at `key`. Panics if there is none or more than one.
pub fn only_reply(replies: &FifoChannelHandler<Reply>, key: &str) -> Answer {
    let mut replies: Vec<Reply> = std::iter::from_fn(|| replies.recv().ok()).collect();
    assert_eq!(replies.len(), 1, "replies at {key}: {replies:?}");
    match replies.remove(0).into_result() {
        Ok(sample) => Ok(sample.payload().to_bytes().into_owned()),
        Err(error) => {
            let bytes = error.payload().to_bytes();
            Err(decode(&bytes).unwrap_or_else(|_| panic!("{key}: {} is not a typed error", bytes.escape_ascii())))
        }
    }
}

/// Encodes a reset of all environments.
pub fn reset_bytes(lease: &LeaseReply, seq: u64) -> Vec<u8> {
    encode(&ResetRequest { protocol: PROTOCOL, epoch: lease.epoch, seq, seeds: None, mask: None })
}

/// Encodes a step with all actions 0.5.
pub fn step_bytes(lease: &LeaseReply, seq: u64) -> Vec<u8> {
    step_with(lease, seq, &vec![0.5; lease.num_envs as usize * lease.spec.action_len()])
}

/// Encodes a step with these actions, of any length.
pub fn step_with(lease: &LeaseReply, seq: u64, actions: &[f32]) -> Vec<u8> {
    encode(&StepRequest {
        protocol: PROTOCOL,
        epoch: lease.epoch,
        seq,
        actions: as_bytes(actions),
        command: None,
        gait_command: None,
        for_tick: None,
    })
}

/// Returns the total number of steps of the first environment of the task `counter`, from a step reply.
pub fn steps_in(step: &[u8]) -> f32 {
    let reply: StepReply<'_> = decode(step).unwrap();
    tensor::read::<f32>(reply.obs, "obs").unwrap()[0]
}

/// Returns the total number of resets of the first environment of the task `counter`, from a reset reply.
pub fn resets_in(reset: &[u8]) -> f32 {
    let reply: ResetReply<'_> = decode(reset).unwrap();
    tensor::read::<f32>(reply.obs, "obs").unwrap()[1]
}
