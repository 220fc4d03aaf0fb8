//! Many faults on many lanes at once, added up.

use std::collections::BTreeMap;
use std::fmt::Write;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::channel;
use std::time::Duration;

use twinstep_model::stream;

use crate::fault::Fault;
use crate::test_bed::{TestBed, TestBedConfig};

/// What to inject.
pub struct FaultPlan {
    /// What the processes run.
    pub commands: TestBedConfig,
    /// Number of faults.
    pub faults: usize,
    /// Lanes at once; every second one has a router.
    pub lanes: usize,
    /// Seed of the faults and their moments.
    pub seed: u64,
}

/// What came of it.
#[derive(Debug, Default)]
pub struct FaultReport {
    /// How often each fault was injected.
    pub injected: BTreeMap<Fault, usize>,
    /// The fault and the evidence of everything that went wrong.
    pub failures: Vec<(Fault, String)>,
    /// Steps that clients acknowledged, each checked.
    pub steps: u64,
    /// The longest time from a fault's end to the third step after it.
    pub slowest: Duration,
}

impl FaultReport {
    /// Faults injected in all.
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
            "longest time from a fault's end to the third step after it: {:.1} s",
            self.slowest.as_secs_f64()
        )?;
        formatter.write_str(&table)
    }
}

/// Injects the faults of `plan`. `progress` is told of each; `stop` ends early.
pub fn run(plan: &FaultPlan, stop: &AtomicBool, progress: impl Fn(Fault)) -> Result<FaultReport, String> {
    let (sender, outcomes) = channel();
    std::thread::scope(|scope| {
        let threads: Vec<_> = (0..plan.lanes)
            .map(|index| {
                let sender = sender.clone();
                let share = plan.faults / plan.lanes + usize::from(index < plan.faults % plan.lanes);
                scope.spawn(move || {
                    run_lane(plan, index, share, stop, |fault, failure| {
                        // The receiver outlives every lane.
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
            let (steps, slowest) = thread.join().map_err(|_| "a lane panicked".to_owned())??;
            tally.steps += steps;
            tally.slowest = tally.slowest.max(slowest);
        }
        Ok(tally)
    })
}

/// Injects `share` faults; a lane that does not go on is started anew. Returns the acknowledged steps, and the
/// longest time to go on.
fn run_lane(
    plan: &FaultPlan,
    index: usize,
    share: usize,
    stop: &AtomicBool,
    report: impl Fn(Fault, Option<String>),
) -> Result<(u64, Duration), String> {
    let with_router = index % 2 == 1;
    let mut random = stream(plan.seed, "faults", index as u64);
    let start = || TestBed::start(&plan.commands, with_router);
    let mut lane = start()?;
    let (mut steps, mut slowest) = (0, Duration::ZERO);
    for _ in 0..share {
        if stop.load(Ordering::Acquire) {
            break;
        }
        let fault = Fault::draw(&mut random, lane.has_router());
        let outcome = lane.inject(fault, &mut random);
        let failed = outcome.is_err();
        report(fault, outcome.err());
        if failed {
            steps += lane.steps;
            slowest = slowest.max(lane.slowest);
            lane = start()?;
        }
    }
    Ok((steps + lane.steps, slowest.max(lane.slowest)))
}
