//! Fuzzing: random changes to valid messages and files, which the decoders must reject or read without a panic and
//! within a limit of memory.
//!
//! Input `index` of a format depends only on the seed and the index ([`input`]), so that it can be made again. A worker
//! process reads inputs one after another ([`worker`]). The memory limit is that of its allocator: an input that needs
//! more ends the process. The [`campaign`] starts the workers, and finds the input that ended one.

pub mod campaign;
pub mod files;
pub mod format;
pub mod input;
pub mod log_examples;
pub mod mutation;
pub mod policies;
pub mod readers;
pub mod report;
pub mod weights_examples;
pub mod wire;
pub mod worker;
