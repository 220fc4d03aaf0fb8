//! The table of a campaign.

use std::fmt::Write;
use std::time::Duration;

use super::campaign::FormatResult;
use super::format::Format;
use super::worker::BatchResult;

/// Returns the table of a campaign as Markdown.
pub fn table(results: &[FormatResult], seed: u64, threads: usize, time: Duration) -> String {
    let mut text = format!(
        "Seed {seed}, {threads} worker processes at the same time, {:.0} s. `decoded`: passed the syntax of the \
         format. `accepted`: passed\nevery check. Memory: the largest need of one input, and the limit of an input of \
         n bytes.\n\n| format | inputs | inputs/s of one worker | decoded | accepted | memory [KiB] | limit [KiB] | findings \
         |\n|---|---|---|---|---|---|---|---|\n",
        time.as_secs_f64()
    );
    let (messages, files): (Vec<_>, Vec<_>) = results.iter().partition(|result| result.format.is_message());
    for (name, group) in [("all messages", messages), ("all files", files)] {
        for result in &group {
            let limit = limit(result.format);
            line(&mut text, result.format.name(), &result.total, result.time, &limit, result.findings.len());
        }
        if group.len() > 1 {
            let findings = group.iter().map(|result| result.findings.len()).sum();
            line(&mut text, name, &sum(&group), group.iter().map(|result| result.time).sum(), "", findings);
        }
    }
    for finding in results.iter().flat_map(|result| &result.findings) {
        let _ = writeln!(text, "\nFOUND {}: {}", finding.file.display(), finding.reason);
    }
    text
}

fn limit(format: Format) -> String {
    let limit = format.memory_limit();
    format!("{} + {} n/1024", limit.constant >> 10, limit.factor)
}

fn sum(group: &[&FormatResult]) -> BatchResult {
    let total = |of: fn(&BatchResult) -> u64| group.iter().map(|result| of(&result.total)).sum();
    BatchResult {
        inputs: total(|result| result.inputs),
        decoded: total(|result| result.decoded),
        accepted: total(|result| result.accepted),
        memory: group.iter().map(|result| result.total.memory).max().unwrap_or(0),
        panics: Vec::new(),
    }
}

fn line(text: &mut String, name: &str, total: &BatchResult, time: Duration, limit: &str, findings: usize) {
    let share = |count: u64| 100.0 * count as f64 / total.inputs.max(1) as f64;
    let rate = total.inputs as f64 / time.as_secs_f64().max(1e-9);
    let _ = writeln!(
        text,
        "| {name} | {} | {rate:.0} | {:.2} % | {:.2} % | {} | {limit} | {findings} |",
        total.inputs,
        share(total.decoded),
        share(total.accepted),
        total.memory >> 10,
    );
}
