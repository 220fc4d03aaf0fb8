//! What other threads see of the control loop, and what they ask of it.

use std::collections::VecDeque;
use std::net::SocketAddr;
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError, TryLockError};
use std::time::{Duration, Instant};

use twinstep_model::PerJoint;

use crate::command_datagram::WriterGuid;
use crate::fault::Fault;
use crate::input::{Action, ActionRefused, Client, OperatorRequest, RequestRefused};
use crate::reading::Reading;
use crate::state::State;
use crate::timing::Timing;
use crate::watchdog::Watchdog;

/// Access to a running control loop. Clones are the same loop.
///
/// The loop waits for none of the locks: what is locked by another thread it reads or writes at its next step.
#[derive(Clone, Default)]
pub struct RobotHandle(Arc<Shared>);

#[derive(Default)]
struct Shared {
    inbox: Mutex<Inbox>,
    board: Mutex<Board>,
    timing: Mutex<Timing>,
    /// Readings and commands of the last steps, oldest first; `None` until somebody asks for them.
    samples: Mutex<Option<VecDeque<TimedSample>>>,
    /// The board has a new tick or state.
    changed: Condvar,
    /// Addresses of those who read the commands.
    readers: Mutex<Vec<SocketAddr>>,
    /// Id of the writer of the robot's states; zero before it is known.
    robot: [AtomicU64; 2],
    has_panicked: AtomicBool,
    stop_requested: AtomicBool,
    /// Number of stops so far.
    stops: AtomicU64,
    is_ending: AtomicBool,
    foreign_writers: AtomicUsize,
    controller_released: AtomicBool,
    release_requested: AtomicBool,
}

/// Time in which the control loop answers a request that has expired.
const ANSWER_TIME: Duration = Duration::from_millis(100);
/// Largest number of samples that are kept: those of 2 s.
const MAX_SAMPLES: usize = 1000;

/// Reading of a step of the loop, with the command that was sent after it.
#[derive(Clone, Debug)]
pub(crate) struct TimedSample {
    /// Time of the step.
    pub at: Duration,
    /// The reading.
    pub reading: Reading,
    /// Commanded joint positions [rad].
    pub q_cmd: PerJoint,
    /// Position gain of the command [N·m/rad].
    pub kp: f32,
}

/// What the loop takes in at its next step.
#[derive(Default)]
struct Inbox {
    requests: VecDeque<Request>,
    /// Number of requests so far.
    num_requests: u64,
    action: Option<(u64, Action)>,
    /// Number of clients that hold the robot: none or one.
    clients: usize,
    ends_episode: bool,
    /// Number of actions so far.
    actions: u64,
}

/// A request of the operator.
struct Request {
    number: u64,
    request: OperatorRequest,
    /// Time after which it is not executed any more.
    end: Instant,
    /// Number of stops before it; it is not executed after a later one.
    stops: u64,
}

/// What the loop takes in at one step.
#[derive(Default)]
pub(crate) struct Taken {
    /// The request with its number, or the reason why it is not executed any more.
    pub request: Option<(u64, Result<OperatorRequest, RequestRefused>)>,
    /// The action with its number.
    pub action: Option<(u64, Action)>,
    pub client: Option<Client>,
    pub has_client: bool,
}

/// State of the loop after its last step.
#[derive(Clone, Debug, Default, PartialEq)]
#[allow(clippy::struct_excessive_bools, reason = "the flags are independent")]
pub struct Board {
    /// Time of the last step since the start of the loop's clock.
    pub now: Duration,
    /// State of the safety state machine; `None` before the first step.
    pub state: Option<State>,
    /// Fault that was not cleared by arming again.
    pub fault: Option<Fault>,
    /// Present policy period.
    pub tick: u64,
    /// Number of policy periods in a row without an action.
    pub missed_ticks: u64,
    /// Action in force; zero if there is none.
    pub applied: [f32; 12],
    /// Newest measurements, with the time when they arrived.
    pub reading: Option<(Duration, Reading)>,
    /// Number of the last action, and why it was not executed.
    pub action_result: (u64, Option<ActionRefused>),
    /// Number of the last request of the operator that was executed or refused, and why it was refused.
    pub request_result: (u64, Option<RequestRefused>),
    /// False after a fault, until the operator lets the client act again.
    pub is_permitted: bool,
    /// What the watchdog does.
    pub watchdog: Watchdog,
    /// True while a client holds the robot.
    pub has_client: bool,
    /// Number of other writers of `rt/lowcmd`.
    pub foreign_writers: usize,
    /// True if the built-in controller is released.
    pub controller_released: bool,
    /// True once the loop has ended.
    pub has_ended: bool,
}

impl RobotHandle {
    /// Asks the loop for something on behalf of the operator, who did so after `stops` stops, and waits for the answer. A
    /// request that is not taken within `timeout`, or before the next stop, is never executed.
    pub fn request(&self, request: OperatorRequest, stops: u64, timeout: Duration) -> Result<(), RequestRefused> {
        let number = self.enqueue(request, stops, Instant::now() + timeout);
        // The loop answers also a request that has expired.
        let board = self.wait_until(timeout + ANSWER_TIME, |board| board.request_result.0 >= number);
        match board.request_result {
            (answered, refused) if answered == number => refused.map_or(Ok(()), Err),
            _ => Err(RequestRefused::Expired),
        }
    }

    fn enqueue(&self, request: OperatorRequest, stops: u64, end: Instant) -> u64 {
        let mut inbox = lock(&self.0.inbox);
        inbox.num_requests += 1;
        let number = inbox.num_requests;
        inbox.requests.push_back(Request { number, request, end, stops });
        number
    }

    /// Releases the robot's built-in controller, in the background.
    pub fn release_controller(&self) {
        self.0.release_requested.store(true, Ordering::Release);
    }

    /// Damps the motors at the next step of the loop, until the operator arms again. Never waits.
    pub fn stop(&self) {
        self.0.stops.fetch_add(1, Ordering::AcqRel);
        self.0.stop_requested.store(true, Ordering::Release);
    }

    /// Returns the number of stops so far.
    pub fn num_stops(&self) -> u64 {
        self.0.stops.load(Ordering::Acquire)
    }

    /// Ends the loop. An armed robot is damped first.
    pub fn end(&self) {
        self.0.is_ending.store(true, Ordering::Release);
    }

    /// Returns the state after the last step.
    pub fn board(&self) -> Board {
        lock(&self.0.board).clone()
    }

    /// Returns how punctual the loop has been until the last tick.
    pub fn timing(&self) -> Timing {
        lock(&self.0.timing).clone()
    }

    /// Waits until `is_met`, or the timeout. Returns the state then.
    pub fn wait_until(&self, timeout: Duration, is_met: impl Fn(&Board) -> bool) -> Board {
        let end = Instant::now() + timeout;
        let mut board = lock(&self.0.board);
        while !is_met(&board) && !board.has_ended {
            let left = end.saturating_duration_since(Instant::now());
            if left.is_zero() {
                break;
            }
            board = self.0.changed.wait_timeout(board, left).unwrap_or_else(PoisonError::into_inner).0;
        }
        board.clone()
    }

    /// Takes or gives back the robot.
    pub(crate) fn set_client(&self, is_present: bool) {
        let mut inbox = lock(&self.0.inbox);
        inbox.clients = if is_present { inbox.clients + 1 } else { inbox.clients.saturating_sub(1) };
        inbox.ends_episode |= !is_present;
        inbox.action = None;
    }

    /// Ends the episode: the robot moves to its standing pose.
    pub(crate) fn end_episode(&self) {
        lock(&self.0.inbox).ends_episode = true;
    }

    /// Sends an action. Returns its number.
    pub(crate) fn act(&self, action: Action) -> u64 {
        let mut inbox = lock(&self.0.inbox);
        inbox.actions += 1;
        let number = inbox.actions;
        inbox.action = Some((number, action));
        number
    }

    /// Returns what other threads ask for; nothing if one of them has the lock.
    pub(crate) fn take(&self) -> Taken {
        let Some(mut inbox) = try_lock(&self.0.inbox) else { return Taken::default() };
        let client = match (std::mem::take(&mut inbox.ends_episode), inbox.clients) {
            (true, _) => Client::EndsEpisode,
            (false, 0) => Client::Absent,
            (false, _) => Client::Connected,
        };
        let request = inbox.requests.pop_front();
        let request = request.map(|Request { number, request, end, stops }| {
            let is_stopped = stops != self.num_stops();
            let refused = is_stopped.then_some(RequestRefused::Stopped);
            let refused = refused.or((Instant::now() >= end).then_some(RequestRefused::Expired));
            (number, refused.map_or(Ok(request), Err))
        });
        Taken { request, action: inbox.action.take(), client: Some(client), has_client: inbox.clients > 0 }
    }

    /// Publishes the state after a step, and wakes those who wait for it. Returns false if another thread has the lock.
    pub(crate) fn publish(&self, board: &Board) -> bool {
        let Some(mut published) = try_lock(&self.0.board) else { return false };
        let has_news = published.tick != board.tick
            || published.state != board.state
            || published.request_result.0 != board.request_result.0;
        published.clone_from(board);
        drop(published);
        if has_news {
            self.0.changed.notify_all();
        }
        true
    }

    /// Returns the samples since the last call, oldest first. Sampling begins with the first call.
    pub(crate) fn take_samples(&self) -> Vec<TimedSample> {
        lock(&self.0.samples).get_or_insert_default().drain(..).collect()
    }

    /// Keeps a sample, if somebody has asked for samples.
    pub(crate) fn add_sample(&self, sample: impl FnOnce() -> TimedSample) {
        let Some(mut samples) = try_lock(&self.0.samples) else { return };
        if let Some(samples) = samples.as_mut() {
            if samples.len() == MAX_SAMPLES {
                samples.pop_front();
            }
            samples.push_back(sample());
        }
    }

    pub(crate) fn publish_timing(&self, timing: &Timing) {
        if let Some(mut published) = try_lock(&self.0.timing) {
            published.clone_from(timing);
        }
    }

    pub(crate) fn publish_end(&self) {
        lock(&self.0.board).has_ended = true;
        self.0.changed.notify_all();
    }

    pub(crate) fn take_stop(&self) -> bool {
        self.0.stop_requested.swap(false, Ordering::AcqRel)
    }

    /// Reports that a thread of this process has panicked. The watchdog takes the motors over: nobody knows what the process
    /// still does.
    pub fn report_panic(&self) {
        self.0.has_panicked.store(true, Ordering::Release);
        self.stop();
    }

    pub(crate) fn has_panicked(&self) -> bool {
        self.0.has_panicked.load(Ordering::Acquire)
    }

    /// Sets the writer of the states that is the robot.
    pub(crate) fn set_robot(&self, robot: WriterGuid) {
        let (halves, _) = robot.as_chunks::<8>();
        for (stored, half) in self.0.robot.iter().zip(halves) {
            stored.store(u64::from_be_bytes(*half), Ordering::Release);
        }
    }

    /// Returns the writer of the states that is the robot.
    pub(crate) fn robot(&self) -> Option<WriterGuid> {
        let [first, second] = [0, 1].map(|half: usize| self.0.robot[half].load(Ordering::Acquire).to_be_bytes());
        let guid: WriterGuid = std::array::from_fn(|index| if index < 8 { first[index] } else { second[index - 8] });
        (guid != [0; 16]).then_some(guid)
    }

    /// Sets the addresses of those who read the commands.
    pub(crate) fn set_readers(&self, readers: Vec<SocketAddr>) {
        *lock(&self.0.readers) = readers;
    }

    /// Calls `use_readers` with the addresses of those who read the commands, unless another thread sets them.
    pub(crate) fn with_readers(&self, use_readers: impl FnOnce(&[SocketAddr])) {
        if let Some(readers) = try_lock(&self.0.readers) {
            use_readers(&readers);
        }
    }

    /// Returns true once the loop has ended.
    pub fn has_ended(&self) -> bool {
        lock(&self.0.board).has_ended
    }

    /// Returns true if the loop is to end.
    pub fn is_ending(&self) -> bool {
        self.0.is_ending.load(Ordering::Acquire)
    }

    pub(crate) fn foreign_writers(&self) -> usize {
        self.0.foreign_writers.load(Ordering::Acquire)
    }

    pub(crate) fn set_foreign_writers(&self, writers: usize) {
        self.0.foreign_writers.store(writers, Ordering::Release);
    }

    /// Returns true if the built-in controller is released.
    pub fn controller_released(&self) -> bool {
        self.0.controller_released.load(Ordering::Acquire)
    }

    pub(crate) fn set_controller_released(&self, is_released: bool) {
        self.0.controller_released.store(is_released, Ordering::Release);
    }

    pub(crate) fn take_release_request(&self) -> bool {
        self.0.release_requested.swap(false, Ordering::AcqRel)
    }
}

/// Locks a mutex unless another thread has it.
fn try_lock<T>(mutex: &Mutex<T>) -> Option<MutexGuard<'_, T>> {
    match mutex.try_lock() {
        Ok(guard) => Some(guard),
        Err(TryLockError::Poisoned(poisoned)) => Some(poisoned.into_inner()),
        Err(TryLockError::WouldBlock) => None,
    }
}

/// Locks a mutex whose data a panic leaves valid.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn request_that_nobody_took_in_time_is_never_executed() {
        let handle = RobotHandle::default();
        let answer = handle.request(OperatorRequest::Stand, 0, Duration::from_millis(1));
        assert_eq!(answer, Err(RequestRefused::Expired));
        assert_eq!(handle.take().request, Some((1, Err(RequestRefused::Expired))));
    }

    #[test]
    fn request_of_before_a_stop_is_never_executed() {
        let (handle, end) = (RobotHandle::default(), Instant::now() + Duration::from_mins(1));
        handle.enqueue(OperatorRequest::Arm, handle.num_stops(), end);
        handle.stop();
        handle.enqueue(OperatorRequest::Arm, handle.num_stops(), end);
        assert_eq!(handle.take().request, Some((1, Err(RequestRefused::Stopped))));
        assert_eq!(handle.take().request, Some((2, Ok(OperatorRequest::Arm))));
    }
}
