//! Results of the campaign as Markdown.

use std::fmt::Write as _;

use super::sequence::{Counterexample, Tally, armed_share};
use super::table::{Cell, Motors, STATES};
use super::wire::{MAX_GAP_MS, WireRun};

/// Returns the table of faults: one line per injection, one column per state.
pub fn table(cells: &[Cell]) -> String {
    let names: Vec<_> = STATES.iter().map(|state| format!("`{state}`")).collect();
    let mut text = format!("| injected | {} |\n|---{}|\n", names.join(" | "), "|---".repeat(STATES.len()));
    for row in cells.chunks(STATES.len()) {
        let entries: Vec<_> = row.iter().map(entry).collect();
        let _ = writeln!(text, "| {} | {} |", row[0].injection.name(), entries.join(" | "));
    }
    text
}

/// Returns the entry of a cell: fault and its time, reaction, end of motors and base.
fn entry(cell: &Cell) -> String {
    let fault = match (cell.fault, cell.reaction) {
        (Some((name, ms)), Some(reaction)) => format!("{name} {ms} ms → `{reaction}`"),
        _ if cell.end == cell.state => "–".to_owned(),
        _ => format!("→ `{}`", cell.end),
    };
    let motors = match cell.motors {
        Motors::Holding => "holding",
        Motors::Damping => "damping",
        Motors::Limp => "limp",
    };
    let mark = if cell.violations.is_empty() { "" } else { "**VIOLATED** " };
    format!("{mark}{fault}; {motors}, {:.2} m", cell.height)
}

/// Returns what differs from the specification, one line each.
pub fn violations(cells: &[Cell]) -> Vec<String> {
    let lines = |cell: &Cell| {
        let (name, state) = (cell.injection.name(), cell.state);
        cell.violations.iter().map(move |violation| format!("{name} in `{state}`: {violation}")).collect::<Vec<_>>()
    };
    cells.iter().flat_map(lines).collect()
}

/// Returns the numbers of the random sequences.
pub fn sequences(tally: &Tally) -> String {
    let steps: u64 = tally.steps.values().sum();
    let counts = |counts: &std::collections::BTreeMap<&str, u64>| {
        counts.iter().map(|(name, count)| format!("{name} {count}")).collect::<Vec<_>>().join(", ")
    };
    let rows = [
        ("sequences", tally.sequences.to_string()),
        ("simulated time [h]", format!("{:.2}", steps as f64 * 0.002 / 3600.0)),
        ("armed [% of the time]", format!("{:.1}", 100.0 * armed_share(tally))),
        ("events", tally.events.to_string()),
        ("requests: accepted, refused", format!("{}, {}", tally.requests[0], tally.requests[1])),
        ("actions: executed, refused", format!("{}, {}", tally.actions[0], tally.actions[1])),
        ("commands that the robot executed", tally.commands.to_string()),
        ("steps in each state", counts(&tally.steps)),
        ("faults", counts(&tally.faults)),
        (
            "first counterexample",
            tally.counterexample.as_ref().map_or("none".to_owned(), |found| found.index.to_string()),
        ),
    ];
    rows.iter().fold("| | |\n|---|---|\n".to_owned(), |text, (name, value)| text + &format!("| {name} | {value} |\n"))
}

/// Returns the results on the wire; nothing without sequences.
pub fn wire(runs: &[WireRun]) -> String {
    if runs.is_empty() {
        return String::new();
    }
    let sum = |value: &dyn Fn(&WireRun) -> u64| runs.iter().map(value).sum::<u64>();
    let mut gaps: Vec<u64> = runs.iter().map(|run| run.largest_gap_ms).collect();
    gaps.sort_unstable();
    let long = gaps.iter().filter(|gap| **gap > MAX_GAP_MS).count();
    let mut text = format!(
        "## Random sequences on the robot's own wire\n\nThe first 10 s of each sequence, with fake robot, `twinstep robot` \
         and client over DDS and Zenoh, in real time, two at a time. Checked are: no command refused or outside a joint's \
         range, none executed while the robot is not armed, and no change of state that needs a request without one. The \
         longest gap is that of a sequence, on the robot's clock; a virtual machine that stands still makes gaps, too.\n\n\
         | | |\n|---|---|\n| sequences | {} |\n| events | {} |\n| commands that the robot executed | {} |\n| steps of the \
         client | {} |\n| violations | {} |\n| longest gap of a moving command, median / largest [ms] | {} / {} |\n\
         | sequences with a gap above {MAX_GAP_MS} ms | {long} |\n",
        runs.len(),
        sum(&|run| run.events as u64),
        sum(&|run| run.accepted),
        sum(&|run| run.steps),
        sum(&|run| run.violations.len() as u64),
        gaps[gaps.len() / 2],
        gaps[gaps.len() - 1],
    );
    for run in runs {
        for violation in &run.violations {
            let _ = writeln!(text, "- VIOLATED in sequence {}: {violation}", run.index);
        }
    }
    text
}

/// Returns a counterexample with its events.
pub fn counterexample(seed: u64, found: &Counterexample) -> String {
    let Counterexample { index, events, at_ms, violation } = found;
    let mut text = format!("sequence {index} of seed {seed}, {at_ms} ms: {violation}\n");
    for (at, event) in events {
        let _ = writeln!(text, "{at:>8} ms  {event}");
    }
    text
}
