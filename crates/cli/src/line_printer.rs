//! Prints lines on a thread that may wait for the reader of stdout or stderr. The others never wait for it.

use std::io::Write;
use std::sync::OnceLock;
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::time::Duration;

/// Number of messages that wait. Later ones are dropped: a terminal that stands still must not cost memory.
const CAPACITY: usize = 4096;
/// Longest time that [`flush`] waits.
const MAX_FLUSH: Duration = Duration::from_millis(300);

/// A message for one of the two outputs.
enum Message {
    Stdout(String),
    Stderr(Vec<u8>),
    Flush(SyncSender<()>),
}

static QUEUE: OnceLock<SyncSender<Message>> = OnceLock::new();

/// Starts the thread.
pub fn start() -> std::io::Result<()> {
    let (queue, messages) = sync_channel(CAPACITY);
    std::thread::Builder::new().name("printer".to_owned()).spawn(move || print(&messages))?;
    let _ = QUEUE.set(queue);
    Ok(())
}

/// Prints a line to stdout. A reader that is gone or does not read must not stop the process, because it holds the robot.
pub fn print_line(line: &str) {
    match QUEUE.get() {
        Some(queue) => drop(queue.try_send(Message::Stdout(line.to_owned()))),
        None => write(&mut std::io::stdout().lock(), format!("{line}\n").as_bytes()),
    }
}

/// Prints a log message to stderr. Returns false if the thread was not started.
pub fn print_log(bytes: &[u8]) -> bool {
    QUEUE.get().map(|queue| drop(queue.try_send(Message::Stderr(bytes.to_owned())))).is_some()
}

/// Waits until everything is printed, but not for long.
pub fn flush() {
    let (done, is_done) = sync_channel(1);
    if QUEUE.get().is_some_and(|queue| queue.try_send(Message::Flush(done)).is_ok()) {
        let _ = is_done.recv_timeout(MAX_FLUSH);
    }
}

fn print(messages: &Receiver<Message>) {
    for message in messages {
        match message {
            Message::Stdout(line) => write(&mut std::io::stdout().lock(), format!("{line}\n").as_bytes()),
            Message::Stderr(bytes) => write(&mut std::io::stderr().lock(), &bytes),
            Message::Flush(done) => drop(done.try_send(())),
        }
    }
}

fn write(output: &mut dyn Write, bytes: &[u8]) {
    let _ = output.write_all(bytes).and_then(|()| output.flush());
}
