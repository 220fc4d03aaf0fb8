//! Faults and the state that must hold after each.

use std::time::Duration;

use rand::RngExt;
use twinstep_model::Stream;

/// A fault injected into a test bed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Fault {
    /// SIGKILL during a step, then a restart. The client receives an error, acquires a new lease and continues.
    ServerKilled,
    /// SIGKILL, then another client that reclaims the lease: the counters continue from their values. A client that
    /// does not support reclaiming acquires a new lease.
    ClientKilled,
    /// SIGKILL of the router, then a new one: the lease remains valid.
    RouterKilled,
    /// SIGSTOP and SIGCONT of the client, sometimes for longer than Zenoh's link timeout: the lease remains valid.
    ClientFrozen,
    /// SIGSTOP and SIGCONT of the server, for longer than the client's timeout: the lease remains valid.
    ServerFrozen,
    /// Every message between client and server is delayed for up to 3 s: the lease remains valid.
    MessagesDelayed,
    /// Every request is sent three times at once: it is executed once, and the three replies are equal.
    RequestRepeated,
    /// A second server of the same robot is started. Behind a router a new client uses one of them. At the same endpoint
    /// the second server cannot start. The client continues.
    SecondServer,
    /// Another client uses and reclaims the lease without its secret: every request is refused.
    LeaseAttacked,
    /// Another client sends thousands of requests and reads no reply: the lease remains valid.
    RepliesUnread,
}

impl Fault {
    /// All faults.
    pub const ALL: [Fault; 10] = [
        Fault::ServerKilled,
        Fault::ClientKilled,
        Fault::RouterKilled,
        Fault::ClientFrozen,
        Fault::ServerFrozen,
        Fault::MessagesDelayed,
        Fault::RequestRepeated,
        Fault::SecondServer,
        Fault::LeaseAttacked,
        Fault::RepliesUnread,
    ];

    /// Returns the name used in tables.
    pub const fn name(self) -> &'static str {
        match self {
            Fault::ServerKilled => "server killed during a step, restarted",
            Fault::ClientKilled => "client killed, lease reclaimed",
            Fault::RouterKilled => "router killed, restarted",
            Fault::ClientFrozen => "client suspended, resumed",
            Fault::ServerFrozen => "server suspended beyond the timeout, resumed",
            Fault::MessagesDelayed => "messages delayed",
            Fault::RequestRepeated => "requests sent three times at once",
            Fault::SecondServer => "second server of the same robot started",
            Fault::LeaseAttacked => "lease used by another client",
            Fault::RepliesUnread => "another client reads no replies",
        }
    }

    /// Samples one of `faults` uniformly. [`Fault::RouterKilled`] is sampled only if there is a router.
    ///
    /// Without a router there must be another one.
    pub fn draw(faults: &[Fault], random: &mut Stream, has_router: bool) -> Self {
        loop {
            let fault = faults[random.random_range(0..faults.len())];
            if has_router || fault != Fault::RouterKilled {
                return fault;
            }
        }
    }
}

/// Samples a duration uniformly from `range` [ms].
pub fn moment(random: &mut Stream, range: std::ops::Range<u64>) -> Duration {
    Duration::from_millis(random.random_range(range))
}
