//! The result of a soak test as text.

use std::fmt::Write;

use twinstep_model::stream;

use super::monitor::Sample;
use super::run::{Plan, SoakResult};
use super::trend::{Trend, trend};

/// Number of samples below which no trend is estimated.
const MIN_SAMPLES: usize = 60;

/// Returns the result as Markdown.
pub fn text(plan: &Plan, result: &SoakResult) -> String {
    let mut text = String::new();
    let total: usize = result.clients.values().sum();
    let _ = writeln!(text, "| client | number | failed |\n|---|---|---|");
    for (fate, count) in &result.clients {
        let failed = result.failures.iter().filter(|(failed, _)| failed == fate).count();
        let _ = writeln!(text, "| {} | {count} | {failed} |", fate.description());
    }
    let _ = writeln!(text, "| all | {total} | {} |", result.failures.len());
    let Sample { resident_kib, anonymous_kib, threads, files } = result.before;
    let after = result.after;
    let most = |of: fn(&Sample) -> u64| result.samples.iter().map(of).max().unwrap_or(0);
    let _ = writeln!(text, "\n| server | before | maximum | after |\n|---|---|---|---|");
    for (name, before, most, after) in [
        ("threads", threads, most(|sample| sample.threads), after.threads),
        ("open files", files, most(|sample| sample.files), after.files),
        ("resident memory [KiB]", resident_kib, most(|sample| sample.resident_kib), after.resident_kib),
        ("heap and stacks [KiB]", anonymous_kib, most(|sample| sample.anonymous_kib), after.anonymous_kib),
    ] {
        let _ = writeln!(text, "| {name} | {before} | {most} | {after} |");
    }
    let _ = writeln!(text, "| environments that are not free | 0 | | {} |", result.leaked_envs);
    let hello = result.longest_hello.as_secs_f64();
    let _ = writeln!(
        text,
        "\n{} environment steps. Longest reply to `hello` of another client: {hello:.2} s.",
        result.env_steps
    );
    if result.samples.len() >= MIN_SAMPLES {
        text.push_str(&memory_trends(plan, result, total));
    }
    for (fate, evidence) in &result.failures {
        let _ = writeln!(text, "\nFAILED, client that {}: {evidence}", fate.description());
    }
    text
}

fn memory_trends(plan: &Plan, result: &SoakResult, clients: usize) -> String {
    let mut text = "\n| heap and stacks | slope [KiB/h] | 95 % interval | slope [B per client] | 95 % interval |\n\
                    |---|---|---|---|---|\n"
        .to_owned();
    let half = result.samples.len() / 2;
    let clients_per_hour = 3600.0 * clients as f64 / result.samples.len() as f64;
    for (name, samples) in [("first half", &result.samples[..half]), ("second half", &result.samples[half..])] {
        let memory: Vec<f64> = samples.iter().map(|sample| sample.anonymous_kib as f64).collect();
        let Trend { slope, interval } = trend(&memory, &mut stream(plan.seed, "bootstrap", 0));
        let per_hour = |slope: f64| 3600.0 * slope;
        let per_client = |slope: f64| 1024.0 * per_hour(slope) / clients_per_hour;
        let [low, high] = interval;
        let _ = writeln!(
            text,
            "| {name} | {:.0} | {:.0} to {:.0} | {:.0} | {:.0} to {:.0} |",
            per_hour(slope),
            per_hour(low),
            per_hour(high),
            per_client(slope),
            per_client(low),
            per_client(high),
        );
    }
    text
}
