//! The faults, and what each must leave true.

use std::time::Duration;

use rand::RngExt;
use twinstep_model::Stream;

/// What is done to a lane.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Fault {
    /// SIGKILL in the middle of a step, then a new start: the client is told, leases anew and goes on.
    ServerKilled,
    /// SIGKILL, then another client that reclaims the lease: the counters go on where they were. A client that cannot
    /// reclaim starts anew.
    ClientKilled,
    /// SIGKILL of the router, then a new one: the lease goes on.
    RouterKilled,
    /// SIGSTOP and SIGCONT, sometimes past Zenoh's own patience: the lease goes on.
    ClientFrozen,
    /// SIGSTOP and SIGCONT, past the client's timeout: the lease goes on.
    ServerFrozen,
    /// Every message between client and server held back for a while: the lease goes on.
    MessagesDelayed,
    /// Every request sent three times at once: executed once, answered three times alike.
    RequestRepeated,
    /// A second server of the same name or at the same endpoint: refused, and the client goes on.
    SecondServer,
}

impl Fault {
    /// Every fault.
    pub const ALL: [Fault; 8] = [
        Fault::ServerKilled,
        Fault::ClientKilled,
        Fault::RouterKilled,
        Fault::ClientFrozen,
        Fault::ServerFrozen,
        Fault::MessagesDelayed,
        Fault::RequestRepeated,
        Fault::SecondServer,
    ];

    /// What it is called in tables.
    pub const fn name(self) -> &'static str {
        match self {
            Fault::ServerKilled => "server killed in mid-step, restarted",
            Fault::ClientKilled => "client killed, lease reclaimed",
            Fault::RouterKilled => "router killed, restarted",
            Fault::ClientFrozen => "client frozen, thawed",
            Fault::ServerFrozen => "server frozen past the timeout, thawed",
            Fault::MessagesDelayed => "messages delayed",
            Fault::RequestRepeated => "requests sent three times at once",
            Fault::SecondServer => "second server started by mistake",
        }
    }

    /// Any fault; [`Fault::RouterKilled`] only where there is a router.
    pub fn draw(random: &mut Stream, has_router: bool) -> Self {
        loop {
            let fault = Self::ALL[random.random_range(0..Self::ALL.len())];
            if has_router || fault != Fault::RouterKilled {
                return fault;
            }
        }
    }
}

/// A random time in `range` [ms].
pub fn moment(random: &mut Stream, range: std::ops::Range<u64>) -> Duration {
    Duration::from_millis(random.random_range(range))
}
