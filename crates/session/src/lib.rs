//! Opens a Zenoh session.
//!
//! `zenoh::open` is generic: every crate that calls it compiles Zenoh's runtime again, which takes 21 s. Server and
//! client call this function instead.

use zenoh::{Config, Session, Wait};

/// Environment variable with the numbers of Zenoh's threads, and its value for a server. It is read at the first session.
///
/// With one thread that sends, Zenoh's default, all links wait while the link of a client that does not read is closed.
pub const SERVER_THREADS: (&str, &str) =
    ("ZENOH_RUNTIME", "(tx: (worker_threads: 4), rx: (worker_threads: 4), net: (worker_threads: 4))");

/// Opens a session and waits until it is open.
pub fn open(config: Config) -> Result<Session, zenoh::Error> {
    zenoh::open(config).wait()
}
