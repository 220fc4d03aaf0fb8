//! Benchmarks of Twinstep and of its baselines, in one run.
//!
//! Each module has one function `measure` that returns [`Measurement`]s. A case is the median of
//! [`throughput::WINDOWS`] windows; Twinstep and the reference are measured alternately.

pub mod baselines;
pub mod ensemble;
mod error;
pub mod identify;
mod link;
pub mod remote;
pub mod remote_training;
pub mod robots;
pub mod sim;
pub mod tcp;
pub mod throughput;
pub mod transport;
pub mod view;

use serde::Serialize;

pub use error::{BenchError, Interrupted};

/// One measured number.
#[derive(Clone, Debug, Serialize)]
pub struct Measurement {
    /// Case that was measured.
    pub case: String,
    /// Measured value, in [`Measurement::unit`].
    pub value: f64,
    /// Unit of the value.
    pub unit: &'static str,
    /// Reference that the value is compared with.
    pub reference: Option<String>,
    /// Ratio of Twinstep to the reference; above 1 is better.
    pub ratio: Option<f64>,
}

/// Measurements and the machine that they were made on.
#[derive(Debug, Serialize)]
pub struct Results {
    /// Measurements, in the order in which they were made.
    pub rows: Vec<Measurement>,
    /// The machine.
    pub machine: Machine,
}

/// The machine that a benchmark ran on.
#[derive(Debug, Serialize)]
pub struct Machine {
    /// Model name of the processor.
    pub cpu: String,
    /// Number of logical cores.
    pub cores: usize,
    /// Operating system.
    pub os: &'static str,
    /// Processor architecture.
    pub arch: &'static str,
}

impl Machine {
    /// Returns the description of this machine.
    pub fn this() -> Self {
        let cpuinfo = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
        let model = cpuinfo.lines().find_map(|line| line.strip_prefix("model name")?.split_once(": "));
        Machine {
            cpu: model.map_or_else(|| "unknown CPU".to_owned(), |(_, name)| name.to_owned()),
            cores: std::thread::available_parallelism().map_or(1, std::num::NonZero::get),
            os: std::env::consts::OS,
            arch: std::env::consts::ARCH,
        }
    }
}
