//! Threads that execute requests and send replies, and the mailboxes that requests wait in.
//!
//! A reply to a client that does not read can block its sender until Zenoh closes the link. A thread that sends a reply
//! therefore does not count as running: another thread executes the next request. A mailbox has at most one request in
//! execution or one reply being sent, so a client that does not read delays only the mailboxes that it writes to.
//!
//! A request that takes long is executed in slices: after each, the mailbox goes to the end of its client's queue. Clients take
//! turns, however many leases each has, and one client never has all threads.
//!
//! The mailboxes that every client may fill share a [`SendLock`]: Zenoh's thread that closes a link waits for all threads
//! that send to it, and serves no other link meanwhile.

use std::collections::VecDeque;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use twinstep_protocol::{ErrorCode, ErrorReply};
use zenoh::query::Query;

use crate::messages::{Reply, Request, RequestKind};

/// Maximum number of threads, of which most can only be sending.
const MAX_THREADS: usize = 512;
/// Time after which a thread without work ends, except the last one.
const KEEP_ALIVE: Duration = Duration::from_secs(5);

/// Executes the requests of mailboxes. Clones share the threads.
#[derive(Clone)]
pub struct Executor(Arc<Shared>);

struct Shared {
    state: Mutex<State>,
    changed: Condvar,
    max_running: usize,
}

#[derive(Default)]
struct State {
    /// Mailboxes with a request and without a thread, by client. The client at the front is next.
    ready: VecDeque<ClientQueue>,
    threads: usize,
    /// Threads that execute a request; those that send a reply do not count.
    running: usize,
    waiting: usize,
    is_stopping: bool,
}

/// Mailboxes of one client.
struct ClientQueue {
    client: String,
    mailboxes: VecDeque<Arc<Mailbox>>,
    /// Threads that execute a request of the client.
    running: usize,
}

impl State {
    /// Appends a mailbox to the queue of its client.
    fn push(&mut self, mailbox: Arc<Mailbox>) {
        if let Some(queue) = self.ready.iter_mut().find(|queue| queue.client == mailbox.client) {
            queue.mailboxes.push_back(mailbox);
        } else {
            let client = mailbox.client.clone();
            self.ready.push_back(ClientQueue { client, mailboxes: VecDeque::from([mailbox]), running: 0 });
        }
    }

    /// Returns true if no mailbox waits for a thread.
    fn is_idle(&self) -> bool {
        self.ready.iter().all(|queue| queue.mailboxes.is_empty())
    }

    /// Returns the index of the first client that has a mailbox and may use another thread.
    fn next_client(&self, max_running: usize) -> Option<usize> {
        let max_of_client = max_running.saturating_sub(1).max(1);
        let may_run = |queue: &ClientQueue| !queue.mailboxes.is_empty() && queue.running < max_of_client;
        if self.running < max_running { self.ready.iter().position(may_run) } else { None }
    }

    /// Takes the next mailbox. Its client goes to the end.
    fn pop(&mut self, max_running: usize) -> Option<Arc<Mailbox>> {
        let index = self.next_client(max_running)?;
        let mut queue = self.ready.remove(index)?;
        let mailbox = queue.mailboxes.pop_front();
        queue.running += 1;
        self.running += 1;
        self.ready.push_back(queue);
        mailbox
    }

    /// Ends the execution of a request of a client.
    fn finish(&mut self, client: &str) {
        self.running -= 1;
        if let Some(queue) = self.ready.iter_mut().find(|queue| queue.client == client) {
            queue.running -= 1;
        }
        self.ready.retain(|queue| queue.running > 0 || !queue.mailboxes.is_empty());
    }
}

impl Executor {
    /// Starts the first thread. At most `max_running` threads execute requests at the same time.
    pub fn start(max_running: usize) -> std::io::Result<Self> {
        let shared = Shared { state: Mutex::default(), changed: Condvar::new(), max_running };
        let this = Self(Arc::new(shared));
        this.spawn(&mut lock(&this.0.state))?;
        Ok(this)
    }

    /// Ends the threads after the requests in the mailboxes have been executed, and waits for them.
    pub fn stop(&self) {
        let mut state = lock(&self.0.state);
        state.is_stopping = true;
        self.0.changed.notify_all();
        while state.threads > 0 {
            state = self.0.changed.wait(state).unwrap_or_else(PoisonError::into_inner);
        }
    }

    fn schedule(&self, mailbox: Arc<Mailbox>) {
        let mut state = lock(&self.0.state);
        state.push(mailbox);
        self.wake_a_thread(&mut state);
    }

    /// Wakes or starts a thread if there is a mailbox that it may execute.
    fn wake_a_thread(&self, state: &mut State) {
        if state.next_client(self.0.max_running).is_none() {
            return;
        }
        if state.waiting > 0 {
            self.0.changed.notify_one();
        } else if state.threads < MAX_THREADS
            && let Err(error) = self.spawn(state)
        {
            // The request waits for one of the threads that there are.
            tracing::warn!(%error, threads = state.threads, "cannot start a thread");
        }
    }

    fn spawn(&self, state: &mut State) -> std::io::Result<()> {
        let this = self.clone();
        std::thread::Builder::new().name("request".to_owned()).spawn(move || this.run())?;
        state.threads += 1;
        Ok(())
    }

    fn run(&self) {
        let mut state = lock(&self.0.state);
        loop {
            if let Some(mailbox) = state.pop(self.0.max_running) {
                // Two requests may have notified the same waiting thread.
                self.wake_a_thread(&mut state);
                drop(state);
                let executed = mailbox.execute_next();
                let mut finished = lock(&self.0.state);
                finished.finish(&mailbox.client);
                self.wake_a_thread(&mut finished);
                drop(finished);
                mailbox.send(executed);
                mailbox.finish();
                state = lock(&self.0.state);
            } else if state.is_stopping && state.is_idle() {
                break;
            } else {
                state.waiting += 1;
                let (awake, wait) =
                    self.0.changed.wait_timeout(state, KEEP_ALIVE).unwrap_or_else(PoisonError::into_inner);
                state = awake;
                state.waiting -= 1;
                if wait.timed_out() && state.is_idle() && state.threads > 1 {
                    break;
                }
            }
        }
        state.threads -= 1;
        self.0.changed.notify_all();
    }
}

/// Executes the requests of one mailbox.
pub trait Handler: Send {
    /// Executes a request, or a slice of it.
    fn handle(&mut self, kind: &RequestKind, query: &Query) -> Handled;
}

/// What became of a request.
pub enum Handled {
    /// It is executed; this is the reply.
    Reply(Reply),
    /// Another mailbox has received it.
    Forwarded,
    /// It is executed further when it is handled again.
    Unfinished,
}

/// Held by the thread that sends a reply.
pub type SendLock = Arc<Mutex<()>>;

/// Queue of requests that are executed in order, one at a time.
pub struct Mailbox {
    /// Client that the requests are from; empty if they are from all.
    client: String,
    queue: Mutex<Queue>,
    /// Maximum size of the requests that wait [bytes]. One request may wait whatever its size.
    max_bytes: usize,
    handler: Mutex<Box<dyn Handler>>,
    send_lock: SendLock,
    executor: Executor,
}

#[derive(Default)]
struct Queue {
    requests: VecDeque<Request>,
    /// Size of these requests [bytes].
    bytes: usize,
    /// True from the first request until the reply to the last one has been sent.
    is_busy: bool,
}

impl Mailbox {
    /// Creates a mailbox for the requests of `client`, in which `max_bytes` wait at most.
    pub fn new(
        executor: &Executor,
        client: &str,
        send_lock: SendLock,
        max_bytes: usize,
        handler: impl Handler + 'static,
    ) -> Arc<Self> {
        let client = client.to_owned();
        let (queue, handler) = (Mutex::default(), Mutex::new(Box::new(handler) as Box<dyn Handler>));
        Arc::new(Self { client, queue, max_bytes, handler, send_lock, executor: executor.clone() })
    }

    /// Enqueues a request. Never blocks. Returns the request if the mailbox is full.
    pub fn push(self: &Arc<Self>, request: Request) -> Result<(), Box<Request>> {
        let mut queue = lock(&self.queue);
        let bytes = request.bytes();
        if queue.bytes + bytes > self.max_bytes && !queue.requests.is_empty() {
            return Err(Box::new(request));
        }
        queue.bytes += bytes;
        queue.requests.push_back(request);
        let was_busy = std::mem::replace(&mut queue.is_busy, true);
        drop(queue);
        if !was_busy {
            self.executor.schedule(Arc::clone(self));
        }
        Ok(())
    }

    /// Returns true if a request waits, is in execution, or its reply is being sent.
    pub fn is_busy(&self) -> bool {
        lock(&self.queue).is_busy
    }

    /// Executes the first request. Returns its query, and the reply if there is one. An unfinished request stays the first.
    fn execute_next(&self) -> Option<(Query, Option<Reply>)> {
        let request = {
            let mut queue = lock(&self.queue);
            let request = queue.requests.pop_front()?;
            queue.bytes -= request.bytes();
            request
        };
        let Request { query, kind } = &request;
        let outcome = catch_unwind(AssertUnwindSafe(|| lock(&self.handler).handle(kind, query)));
        let handled = outcome.unwrap_or_else(|panic| {
            let reason = panic_text(&panic);
            tracing::error!(reason, key = %query.key_expr(), "a request panicked");
            Handled::Reply(Reply::Err(ErrorReply::new(ErrorCode::Internal, "", reason)))
        });
        match handled {
            Handled::Reply(reply) => Some((request.query, Some(reply))),
            Handled::Forwarded => Some((request.query, None)),
            Handled::Unfinished => {
                let mut queue = lock(&self.queue);
                queue.bytes += request.bytes();
                queue.requests.push_front(request);
                None
            }
        }
    }

    /// Sends the reply that [`Mailbox::execute_next`] returned.
    fn send(&self, executed: Option<(Query, Option<Reply>)>) {
        let sending = lock(&self.send_lock);
        if let Some((query, Some(reply))) = &executed {
            reply.send(query);
        }
        // Dropping the query sends a message as well.
        drop(executed);
        drop(sending);
    }

    fn finish(self: Arc<Self>) {
        let mut queue = lock(&self.queue);
        queue.is_busy = !queue.requests.is_empty();
        let is_busy = queue.is_busy;
        drop(queue);
        if is_busy {
            self.executor.clone().schedule(self);
        }
    }
}

/// Returns the text of a panic.
pub fn panic_text(panic: &Box<dyn std::any::Any + Send>) -> String {
    let text = panic.downcast_ref::<&str>().map(|text| (*text).to_owned());
    text.or_else(|| panic.downcast_ref::<String>().cloned()).unwrap_or_else(|| "panicked".to_owned())
}

/// Locks a mutex whose data a panic leaves valid.
pub fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
