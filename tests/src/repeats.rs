//! A client that sends every request three times at once, by hand: no library that repeats stands between.

use std::time::Duration;

use twinstep_envs::{Counter, OBS_LEN};
use twinstep_model::AutoresetMode;
use twinstep_protocol::keys::{self, EnvMethod};
use twinstep_protocol::{PROTOCOL, decode, encode, message, tensor};
use zenoh::query::{ConsolidationMode, QueryTarget};
use zenoh::{Session, Wait};

const TIMEOUT: Duration = Duration::from_secs(5);
const STEPS: u64 = 5;

/// Leases one counter of the server at `endpoint` and steps it, every request three times at once.
pub fn three_times(endpoint: &str) -> Result<(), String> {
    let session = open(endpoint)?;
    let sid = first_server(&session)?;
    let client = format!("repeats-{}", session.zid());
    let _token = session.liveliness().declare_token(keys::live_client(&sid, &client)).wait().map_err(text)?;
    let lease: message::LeaseReply = {
        let request = message::LeaseRequest {
            protocol: PROTOCOL,
            client: client.clone(),
            num_envs: 1,
            autoreset: AutoresetMode::NextStep,
            max_episode_steps: None,
            spec_hash: None,
            reclaim: None,
        };
        // The same client asks three times and must get one lease.
        let answers = ask_three_times(&session, &keys::lease(&sid), encode(&request))?;
        decode(&answers).map_err(text)?
    };
    let key = |verb| keys::env(&sid, &lease.lease, verb);
    let (protocol, epoch) = (PROTOCOL, lease.epoch);
    let reset = message::ResetRequest { protocol, epoch, seq: 1, seeds: None, mask: None };
    ask_three_times(&session, &key(EnvMethod::Reset), encode(&reset))?;
    let mut counter = Counter { resets: 1, ..Counter::default() };
    for step in 1..=STEPS {
        let action = [step as f32; 12];
        let actions = tensor::as_bytes(&action);
        let request = message::StepRequest { protocol, epoch, seq: step + 1, actions };
        let answer = ask_three_times(&session, &key(EnvMethod::Step), encode(&request))?;
        let reply: message::StepReply<'_> = decode(&answer).map_err(text)?;
        let obs: Vec<f32> = tensor::read(reply.obs, "obs").map_err(text)?;
        counter.step(&action);
        if obs.len() != OBS_LEN || obs[..4] != counter.observation() {
            return Err(format!("step {step} sent three times gave {:?}, not {counter:?}", &obs[..4]));
        }
    }
    let close = message::CloseRequest { protocol, epoch, seq: STEPS + 2 };
    ask_three_times(&session, &key(EnvMethod::Close), encode(&close))?;
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
    let (sid, _) = keys::parse_live_server(sample.key_expr().as_str()).ok_or("a foreign key among the servers'")?;
    Ok(sid.to_owned())
}

/// The one answer that all three got. A repeat that comes after a close may find the lease gone.
fn ask_three_times(session: &Session, key: &str, request: Vec<u8>) -> Result<Vec<u8>, String> {
    let send = || {
        session
            .get(key)
            .target(QueryTarget::BestMatching)
            .consolidation(ConsolidationMode::None)
            .timeout(TIMEOUT)
            .payload(request.clone())
            .wait()
            .map_err(text)
    };
    let sent = [send()?, send()?, send()?];
    let mut answers = Vec::new();
    for (index, replies) in sent.iter().enumerate() {
        match replies.recv().map_err(|_| format!("no reply to copy {index} at {key}"))?.into_result() {
            Ok(sample) => answers.push(sample.payload().to_bytes().into_owned()),
            Err(_) if index > 0 && key.ends_with("/close") => {}
            Err(error) => {
                return Err(format!("copy {index} at {key}: {}", String::from_utf8_lossy(&error.payload().to_bytes())));
            }
        }
    }
    if answers.windows(2).any(|pair| pair[0] != pair[1]) {
        return Err(format!("the three answers at {key} differ"));
    }
    answers.pop().ok_or_else(|| format!("no answer at {key}"))
}
