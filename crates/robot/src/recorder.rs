//! Records every message of the robot, without delay for the control loop.

use std::path::Path;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::thread::JoinHandle;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use twinstep_logs::{LogError, McapRecorder, RecordedTopic};

/// Number of messages that wait for the disk: 8 s of states and commands.
const CAPACITY: usize = 8192;

/// Time without a message after which those before are written.
const MAX_SILENCE: Duration = Duration::from_millis(500);

/// Hands messages to the thread that writes the file. Clones write the same file, which is complete once all are dropped.
#[derive(Clone)]
pub struct Recorder {
    messages: SyncSender<Message>,
    /// Time of the start of the control loop's clock since 1970.
    epoch: Arc<std::sync::OnceLock<Duration>>,
}

struct Message {
    topic: RecordedTopic,
    time_ns: u64,
    payload: Vec<u8>,
}

impl Recorder {
    /// Creates the file, which must not exist, and starts the thread that writes it. The thread returns the first error.
    pub fn start(path: &Path) -> Result<(Self, JoinHandle<Result<(), LogError>>), LogError> {
        let file = McapRecorder::create(path)?;
        let (messages, received) = sync_channel(CAPACITY);
        let spawned = std::thread::Builder::new().name("recorder".to_owned()).spawn(move || write(file, &received));
        let thread = spawned.map_err(|cause| LogError::Write { file: path.to_owned(), cause })?;
        Ok((Self { messages, epoch: Arc::default() }, thread))
    }

    /// Records a message with the time on the control loop's clock. Never waits. Returns false if it was dropped,
    /// because the disk is too slow.
    pub fn record(&self, topic: RecordedTopic, now: Duration, payload: Vec<u8>) -> bool {
        let since_1970 = || SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().saturating_sub(now);
        let time_ns = (*self.epoch.get_or_init(since_1970) + now).as_nanos() as u64;
        self.messages.try_send(Message { topic, time_ns, payload }).is_ok()
    }
}

fn write(mut file: McapRecorder, messages: &Receiver<Message>) -> Result<(), LogError> {
    loop {
        let written = match messages.recv_timeout(MAX_SILENCE) {
            Ok(Message { topic, time_ns, payload }) => file.write(topic, time_ns, &payload),
            Err(RecvTimeoutError::Timeout) => file.flush(),
            Err(RecvTimeoutError::Disconnected) => return file.finish(),
        };
        if let Err(error) = written {
            tracing::error!(%error, "the recording has stopped; the robot goes on");
            return Err(error);
        }
    }
}
