//! Threads that run before all others.

use std::thread::JoinHandle;

use thread_priority::{
    RealtimeThreadSchedulePolicy, ThreadPriority, ThreadSchedulePolicy, set_thread_priority_and_policy,
    thread_native_id,
};

/// Priority of the first-in, first-out scheduling, 1 to 99. Any is above that of ordinary threads.
const PRIORITY: u8 = 20;
/// Priority of the watchdog, above that of the threads that it watches.
pub(crate) const WATCHDOG_PRIORITY: u8 = 30;

/// Starts a thread with real-time scheduling. Threads that it starts have it too.
///
/// Without the permission the thread runs as every other, and a log line says so.
pub fn spawn<T: Send + 'static>(
    name: &str,
    task: impl FnOnce() -> T + Send + 'static,
) -> std::io::Result<JoinHandle<T>> {
    std::thread::Builder::new().name(name.to_owned()).spawn(|| {
        raise_priority(PRIORITY);
        task()
    })
}

/// Gives the calling thread real-time scheduling, if it may have it.
pub(crate) fn raise_priority(priority: u8) {
    let priority = ThreadPriority::from_posix(thread_priority::ScheduleParams { sched_priority: i32::from(priority) });
    let policy = ThreadSchedulePolicy::Realtime(RealtimeThreadSchedulePolicy::Fifo);
    if let Err(error) = set_thread_priority_and_policy(thread_native_id(), priority, policy) {
        tracing::info!(
            ?error,
            "no permission for real-time scheduling, so other programs can delay the robot: run as root, or \
             `sudo setcap cap_sys_nice+ep` the program"
        );
    }
}
