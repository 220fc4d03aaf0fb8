//! The text of a mapping file.

use std::fmt::Write as _;

use super::facts::{InputFacts, TermFacts};
use super::merge::{Draft, PER_JOINT};
use crate::mapping::{History, HistoryLayout, HistoryOrder};

/// Returns the text; what was not found is a comment that says so.
pub fn mapping(draft: &Draft) -> String {
    let mut text = String::from("# Mapping of a policy, made by `twinstep import-policy` (docs/run.md).\n");
    let origin = |key: &str| draft.origins.iter().find(|(own, _)| own == key).map_or("", |(_, place)| place.as_str());
    let line = |text: &mut String, key: &str, value: Option<String>| match value {
        Some(value) => writeln!(text, "{key} = {value}  # {}", origin(key)).unwrap_or_default(),
        None => writeln!(text, "# {key} =   # not found").unwrap_or_default(),
    };
    let joints = draft.joints.as_deref();
    line(&mut text, "joints", joints.map(|joints| list(joints.iter().map(|name| format!("\"{name}\"")))));
    for (key, _) in PER_JOINT.iter().filter(|(key, _)| *key != "default_pose") {
        line(&mut text, key, draft.per_joint.get(key).map(|values| numbers(values)));
    }
    line(&mut text, "policy_hz", draft.policy_hz.map(number));
    if let Some([low, high]) = draft.action_clip {
        line(&mut text, "action_clip", Some(format!("[{}, {}]", number(low), number(high))));
    }
    match (draft.per_joint.get("default_pose"), joints) {
        (Some(pose), Some(joints)) => {
            writeln!(text, "\n[default_pose]  # {}", origin("default_pose")).unwrap_or_default();
            for (joint, q) in joints.iter().zip(pose) {
                writeln!(text, "{joint} = {}", number(*q)).unwrap_or_default();
            }
        }
        _ => text.push_str("\n# [default_pose]   # not found\n"),
    }
    match &draft.observation {
        Some(input) => write_input(&mut text, input, "", origin("observation")),
        None => text.push_str("\n# [[observation]]   # not found\n"),
    }
    for (name, input) in &draft.inputs {
        let prefix = format!("input.{name}.");
        if input.history.is_none() && input.terms.is_empty() {
            writeln!(text, "\n[input.{name}]").unwrap_or_default();
        }
        write_input(&mut text, input, &prefix, "");
    }
    text
}

fn write_input(text: &mut String, input: &InputFacts, prefix: &str, origin: &str) {
    if let Some(History { length, layout, order }) = input.history {
        let layout = if layout == HistoryLayout::Terms { "terms" } else { "frames" };
        let order = if order == HistoryOrder::OldestFirst { "oldest_first" } else { "newest_first" };
        writeln!(text, "\n[{prefix}history]\nlength = {length}\nlayout = \"{layout}\"\norder = \"{order}\"")
            .unwrap_or_default();
    }
    for (index, term) in input.terms.iter().enumerate() {
        let comment = if index == 0 && !origin.is_empty() { format!("  # {origin}") } else { String::new() };
        writeln!(text, "\n[[{prefix}observation]]{comment}").unwrap_or_default();
        write_term(text, term);
    }
    for name in &input.unknown {
        writeln!(text, "\n# [[{prefix}observation]]   # `{name}` is not available: add a term `constant` in its place")
            .unwrap_or_default();
    }
}

fn write_term(text: &mut String, term: &TermFacts) {
    writeln!(text, "term = \"{}\"  # {}", term.term.name(), term.name).unwrap_or_default();
    if term.scale.iter().any(|scale| *scale != 1.0) {
        writeln!(text, "scale = {}", numbers(&term.scale)).unwrap_or_default();
    }
    if let Some([low, high]) = term.clip {
        writeln!(text, "clip = [{}, {}]", number(low), number(high)).unwrap_or_default();
    }
    if let Some(steps) = term.history {
        writeln!(text, "history = {steps}").unwrap_or_default();
    }
    for (key, value) in [("period", term.period), ("still_below", term.still_below)] {
        if let Some(value) = value {
            writeln!(text, "{key} = {}", number(value)).unwrap_or_default();
        }
    }
}

/// Returns one number if all are equal, else a list.
fn numbers(values: &[f64]) -> String {
    match values {
        [first, rest @ ..] if rest.iter().all(|value| value == first) => number(*first),
        _ => list(values.iter().map(|value| number(*value))),
    }
}

fn list(items: impl Iterator<Item = String>) -> String {
    format!("[{}]", items.collect::<Vec<_>>().join(", "))
}

/// Returns a number of TOML, without the noise of single precision: 49.99999 is 50, and 0.800000011920929 is 0.8.
fn number(value: f64) -> String {
    let rounded = (value * 1e6).round() / 1e6;
    let value = if (value - rounded).abs() <= 2e-7 * value.abs().max(1e-6) { rounded } else { value };
    let value = if (value - value.round()).abs() < 1e-6 { value.round() } else { value };
    format!("{value:?}")
}
