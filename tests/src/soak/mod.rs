//! Soak test: many clients come to a real server, and leave or fail in different ways, while its memory, threads and
//! open files are sampled.
//!
//! - [`visit`]: one client, from its connection to its end.
//! - [`run`]: the server, the clients in parallel, and the result.
//! - [`monitor`]: samples of the server's process.
//! - [`trend`]: slope of the memory with an interval.
//! - [`report`]: the result as text.

pub mod monitor;
pub mod report;
pub mod run;
pub mod trend;
pub mod visit;
