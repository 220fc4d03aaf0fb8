//! Opens a Zenoh session.
//!
//! `zenoh::open` is generic: every crate that calls it compiles Zenoh's runtime again, which takes 21 s. Server and
//! client call this function instead.

use zenoh::{Config, Session, Wait};

/// Opens a session and waits until it is open.
pub fn open(config: Config) -> Result<Session, zenoh::Error> {
    zenoh::open(config).wait()
}
