//! A client that sends every request three times at once, without the client library and its own repeats.

use std::time::Duration;

use twinstep_envs::{Counter, OBS_LEN};
use twinstep_model::AutoresetMode;
use twinstep_protocol::keys::{self, EnvMethod};
use twinstep_protocol::{PROTOCOL, Secret, decode, encode, message, tensor};
use zenoh::query::{ConsolidationMode, QueryTarget};
use zenoh::{Session, Wait};

const TIMEOUT: Duration = Duration::from_secs(5);
const STEPS: u64 = 5;

/// Leases one counter of the server at `endpoint` and steps it. Sends every request three times at once.
pub fn three_times(endpoint: &str) -> Result<(), String> {
    let session = open(endpoint)?;
    let sid = first_server(&session)?;
    let client = format!("repeats-{}", session.zid());
    let _token = session.liveliness().declare_token(keys::live_client(&sid, &client)).wait().map_err(text)?;
    let secret = Secret::random();
    let request_three_times = |key: &str, request| request_three_times(&session, secret, key, request);
    let lease: message::LeaseReply = {
        let request = message::LeaseRequest {
            protocol: PROTOCOL,
            client: client.clone(),
            num_envs: 1,
            autoreset: AutoresetMode::NextStep,
            max_episode_steps: None,
            critic: false,
            spec_hash: None,
            reclaim: None,
        };
        // Three requests of the same client must yield one lease.
        let reply = request_three_times(&keys::lease(&sid), encode(&request))?;
        decode(&reply).map_err(text)?
    };
    let key = |verb| keys::env(&sid, &lease.lease, verb);
    let (protocol, epoch) = (PROTOCOL, lease.epoch);
    let reset = message::ResetRequest { protocol, epoch, seq: 1, seeds: None, mask: None };
    request_three_times(&key(EnvMethod::Reset), encode(&reset))?;
    let mut counter = Counter { resets: 1, ..Counter::default() };
    for step in 1..=STEPS {
        let action = [step as f32; 12];
        let actions = tensor::as_bytes(&action);
        let request = message::StepRequest {
            protocol,
            epoch,
            seq: step + 1,
            actions,
            command: None,
            gait_command: None,
            for_tick: None,
        };
        let payload = request_three_times(&key(EnvMethod::Step), encode(&request))?;
        let reply: message::StepReply<'_> = decode(&payload).map_err(text)?;
        let obs: Vec<f32> = tensor::read(reply.obs, "obs").map_err(text)?;
        counter.step(&action);
        if obs.len() != OBS_LEN || obs[..4] != counter.observation() {
            return Err(format!("step {step}, sent three times: observed {:?}, expected {counter:?}", &obs[..4]));
        }
    }
    let close = message::CloseRequest { protocol, epoch, seq: STEPS + 2 };
    request_three_times(&key(EnvMethod::Close), encode(&close))?;
    session.close().wait().map_err(text)
}

fn text(error: impl std::fmt::Display) -> String {
    error.to_string()
}

fn open(endpoint: &str) -> Result<Session, String> {
    let mut config = zenoh::Config::default();
    let endpoints = format!("[\"{endpoint}\"]");
    for (key, value) in
        [("mode", "\"client\""), ("connect/endpoints", endpoints.as_str()), ("scouting/multicast/enabled", "false")]
    {
        config.insert_json5(key, value).map_err(text)?;
    }
    twinstep_session::open(config).map_err(text)
}

fn first_server(session: &Session) -> Result<String, String> {
    let replies = session.liveliness().get(keys::LIVE_SERVERS).timeout(TIMEOUT).wait().map_err(text)?;
    let sample = replies.recv().map_err(text)?.into_result().map_err(|error| format!("{error:?}"))?;
    let (sid, _) = keys::parse_live_server(sample.key_expr().as_str()).ok_or("not the liveliness token of a server")?;
    Ok(sid.to_owned())
}

/// Sends `request` three times and returns the reply, which must be the same for all three.
///
/// Repeats of a close may fail because the lease no longer exists.
fn request_three_times(session: &Session, secret: Secret, key: &str, request: Vec<u8>) -> Result<Vec<u8>, String> {
    let send = || {
        session
            .get(key)
            .target(QueryTarget::BestMatching)
            .consolidation(ConsolidationMode::None)
            .timeout(TIMEOUT)
            .payload(request.clone())
            .attachment(secret.as_bytes())
            .wait()
            .map_err(text)
    };
    let sent = [send()?, send()?, send()?];
    let mut payloads = Vec::new();
    for (index, replies) in sent.iter().enumerate() {
        match replies.recv().map_err(|_| format!("no reply to copy {index} at {key}"))?.into_result() {
            Ok(sample) => payloads.push(sample.payload().to_bytes().into_owned()),
            Err(_) if index > 0 && key.ends_with("/close") => {}
            Err(error) => {
                return Err(format!("copy {index} at {key}: {}", String::from_utf8_lossy(&error.payload().to_bytes())));
            }
        }
    }
    if payloads.windows(2).any(|pair| pair[0] != pair[1]) {
        return Err(format!("the three replies at {key} differ"));
    }
    payloads.pop().ok_or_else(|| format!("no reply at {key}"))
}
