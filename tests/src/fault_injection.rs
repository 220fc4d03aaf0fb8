//! Injects many faults into many test beds in parallel and adds up the results.

use std::collections::BTreeMap;
use std::fmt::Write;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::channel;
use std::time::Duration;

use twinstep_model::stream;

use crate::fault::Fault;
use crate::test_bed::{TestBed, TestBedConfig};

/// Attempts to start a test bed.
const STARTS: usize = 5;

/// Settings of a run of fault injection.
pub struct FaultPlan {
    /// Commands of the processes.
    pub commands: TestBedConfig,
    /// Number of faults.
    pub faults: usize,
    /// Faults that are sampled.
    pub kinds: Vec<Fault>,
    /// Number of test beds in parallel. Every second one has a router.
    pub lanes: usize,
    /// Seed of the faults and their times.
    pub seed: u64,
}

/// Result of a run of fault injection.
#[derive(Debug, Default)]
pub struct FaultReport {
    /// Number of injections of each fault.
    pub injected: BTreeMap<Fault, usize>,
    /// Fault and evidence of every failure.
    pub failures: Vec<(Fault, String)>,
    /// Problems of test beds that ended before their share of faults.
    pub unfinished: Vec<String>,
    /// Number of steps that clients acknowledged; each was checked.
    pub steps: u64,
    /// Longest time from the end of a fault to the third step after it.
    pub slowest: Duration,
}

impl FaultReport {
    /// Returns the total number of injected faults.
    pub fn total(&self) -> usize {
        self.injected.values().sum()
    }
}

impl std::fmt::Display for FaultReport {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let mut table = format!("{:<42}{:>9}{:>8}\n", "fault", "injected", "failed");
        for (fault, count) in &self.injected {
            let failed = self.failures.iter().filter(|(failed, _)| failed == fault).count();
            writeln!(table, "{:<42}{count:>9}{failed:>8}", fault.name())?;
        }
        writeln!(table, "{:<42}{:>9}{:>8}", "all", self.total(), self.failures.len())?;
        writeln!(table, "{} acknowledged steps, each compared with the client's own counters", self.steps)?;
        write!(
            table,
            "longest time from the end of a fault to the third step after it: {:.1} s",
            self.slowest.as_secs_f64()
        )?;
        formatter.write_str(&table)
    }
}

/// Injects the faults of `plan`. Calls `progress` for each; stops early once `stop` is true.
pub fn run(plan: &FaultPlan, stop: &AtomicBool, progress: impl Fn(Fault)) -> FaultReport {
    let (sender, outcomes) = channel();
    std::thread::scope(|scope| {
        let threads: Vec<_> = (0..plan.lanes)
            .map(|index| {
                let sender = sender.clone();
                let share = plan.faults / plan.lanes + usize::from(index < plan.faults % plan.lanes);
                scope.spawn(move || {
                    run_test_bed(plan, index, share, stop, |fault, failure| {
                        // The receiver outlives every test bed.
                        let _ = sender.send((fault, failure));
                    })
                })
            })
            .collect();
        drop(sender);
        let mut tally = FaultReport::default();
        for (fault, failure) in outcomes {
            *tally.injected.entry(fault).or_default() += 1;
            tally.failures.extend(failure.map(|evidence| (fault, evidence)));
            progress(fault);
        }
        for thread in threads {
            match thread.join().map_err(|_| "a test bed panicked".to_owned()).flatten() {
                Ok((steps, slowest)) => {
                    tally.steps += steps;
                    tally.slowest = tally.slowest.max(slowest);
                }
                // The report of the other test beds is kept.
                Err(problem) => tally.unfinished.push(problem),
            }
        }
        tally
    })
}

/// Injects `share` faults into one test bed and replaces it after a failure. Returns the number of acknowledged steps
/// and the longest recovery time.
fn run_test_bed(
    plan: &FaultPlan,
    index: usize,
    share: usize,
    stop: &AtomicBool,
    report: impl Fn(Fault, Option<String>),
) -> Result<(u64, Duration), String> {
    let with_router = index % 2 == 1;
    let mut random = stream(plan.seed, "faults", index as u64);
    // A port that was free may be taken by another program before the test bed listens at it.
    let start = || {
        let mut test_bed = TestBed::start(&plan.commands, with_router);
        for _ in 1..STARTS {
            if test_bed.is_err() {
                test_bed = TestBed::start(&plan.commands, with_router);
            }
        }
        test_bed
    };
    let mut test_bed = start()?;
    let (mut steps, mut slowest) = (0, Duration::ZERO);
    for _ in 0..share {
        if stop.load(Ordering::Acquire) {
            break;
        }
        let fault = Fault::draw(&plan.kinds, &mut random, test_bed.has_router());
        let outcome = test_bed.inject(fault, &mut random);
        let failed = outcome.is_err();
        let place = if test_bed.has_router() { "behind a router" } else { "without a router" };
        report(fault, outcome.err().map(|evidence| format!("{evidence} ({place})")));
        if failed {
            steps += test_bed.steps;
            slowest = slowest.max(test_bed.slowest);
            test_bed = start()?;
        }
    }
    Ok((steps + test_bed.steps, slowest.max(test_bed.slowest)))
}
