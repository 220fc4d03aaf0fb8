//! Table of the rates of a blind test, with their 95 % intervals.

use std::collections::BTreeSet;

use crate::CaseResult;
use crate::base_schedule::LogLength;
use crate::draw::CaseKind;
use crate::mismatch::Mismatch;
use crate::score::EffectScore;

/// Returns a row with a rate, k of n, and its 95 % interval.
fn rate(label: &str, aim: &str, outcomes: impl Iterator<Item = bool>) -> String {
    let outcomes: Vec<_> = outcomes.collect();
    let (count, hits) = (outcomes.len(), outcomes.iter().filter(|hit| **hit).count());
    if count == 0 {
        return format!("| {label} | {aim} | no case | |\n");
    }
    let [low, high] = wilson(hits, count);
    let percent = |share: f64| format!("{:.0}", 100.0 * share);
    let share = percent(hits as f64 / count as f64);
    format!("| {label} | {aim} | {hits} of {count}: {share} % | {} to {} % |\n", percent(low), percent(high))
}

/// Returns Wilson's 95 % interval of a binomial rate.
pub fn wilson(hits: usize, count: usize) -> [f64; 2] {
    const Z: f64 = 1.959_964;
    let (n, rate) = (count as f64, hits as f64 / count as f64);
    let middle = rate + Z * Z / (2.0 * n);
    let reach = Z * (rate * (1.0 - rate) / n + Z * Z / (4.0 * n * n)).sqrt();
    [middle - reach, middle + reach].map(|end| (end / (1.0 + Z * Z / n)).clamp(0.0, 1.0))
}

/// Returns the table of rates.
pub fn rates(results: &[CaseResult]) -> String {
    let parts =
        [single_effects, healthy_robots, unmodelled_effects, several_effects, walking_robots, confusable_effects];
    let mut text = "| | goal | rate | 95 % interval |\n|---|---|---|---|\n".to_owned();
    text.extend(parts.map(|rows| rows(results)));
    let hidden = || results.iter().flat_map(|result| &result.verdict.hits);
    if hidden().next().is_some() {
        text +=
            &rate("hidden effect not evident in its log, left out above", "<= 15 %", hidden().map(|hit| !hit.counts()));
    }
    let sizes = hidden().filter_map(|hit| hit.size);
    text += &rate("size within its 95 % interval", "88 to 99 %", sizes.map(|size| size.covered));
    text + &rate("diagnosis failed", "none", results.iter().map(|result| result.error.is_some()))
}

fn of(results: &[CaseResult], kind: CaseKind) -> impl Iterator<Item = &CaseResult> {
    results.iter().filter(move |result| result.kind == kind)
}

/// Returns the scores of the hidden effects that are evident in their logs.
fn hits(results: &[CaseResult], kind: CaseKind) -> impl Iterator<Item = &EffectScore> {
    of(results, kind).flat_map(|result| &result.verdict.hits).filter(|hit| hit.counts())
}

fn has_wrong_name(result: &CaseResult) -> bool {
    result.verdict.wrong_names > 0
}

fn has(results: &[CaseResult], kind: CaseKind) -> bool {
    of(results, kind).next().is_some()
}

fn single_effects(results: &[CaseResult]) -> String {
    let mut text = String::new();
    for (kind, size, first, three, scope) in [
        (CaseKind::LargeEffect, "half the range or more", ">= 90 %", ">= 97 %", ">= 90 %"),
        (CaseKind::SmallEffect, "a fifth of the range", ">= 70 %", "", ""),
    ] {
        if !has(results, kind) {
            continue;
        }
        let of_hits = |good: fn(&EffectScore) -> bool| hits(results, kind).map(good);
        text += &rate(&format!("{size}: top-1 correct"), first, of_hits(|hit| hit.first));
        text += &rate(&format!("{size}: listed as indistinguishable"), "", of_hits(|hit| hit.ambiguous));
        text += &rate(&format!("{size}: top-3 correct"), three, of_hits(|hit| hit.in_top_3));
        text += &rate(&format!("{size}: scope correct"), scope, of_hits(|hit| hit.scope_right));
        text += &rate(&format!("{size}: additional false positive"), "", of(results, kind).map(has_wrong_name));
    }
    let single = || [CaseKind::LargeEffect, CaseKind::SmallEffect].into_iter().flat_map(|kind| hits(results, kind));
    text + &name_set("one effect", single())
}

/// Returns the rows about the set of names of a cause: the cause, and what the log cannot tell apart from it.
fn name_set<'a>(label: &str, hits: impl Iterator<Item = &'a EffectScore>) -> String {
    let hits: Vec<&EffectScore> = hits.collect();
    if hits.is_empty() {
        return String::new();
    }
    let sizes: Vec<usize> = hits.iter().map(|hit| hit.set_size).filter(|size| *size > 0).collect();
    let mean = sizes.iter().sum::<usize>() as f64 / sizes.len().max(1) as f64;
    rate(&format!("{label}: within the set of names"), ">= 90 %", hits.iter().map(|hit| hit.in_set))
        + &format!("| {label}: mean size of the set | <= 2.5 | {mean:.1} | |\n")
}

fn healthy_robots(results: &[CaseResult]) -> String {
    if !has(results, CaseKind::Healthy) {
        return String::new();
    }
    let healthy = || of(results, CaseKind::Healthy);
    let mut text = rate("nothing hidden: false positive", "<= 7 %", healthy().map(has_wrong_name));
    let mut add = |name: &str, outcomes: &mut dyn Iterator<Item = bool>| {
        let outcomes: Vec<bool> = outcomes.collect();
        if !outcomes.is_empty() {
            text += &rate(&format!("nothing hidden, {name}: false positive"), "", outcomes.into_iter());
        }
    };
    for family in Mismatch::ALL {
        add(family.name(), &mut healthy().filter(|result| result.mismatch == Some(family)).map(has_wrong_name));
    }
    if healthy().any(|result| result.setting.length != LogLength::Standard) {
        for length in LogLength::ALL {
            add(length.name(), &mut healthy().filter(|result| result.setting.length == length).map(has_wrong_name));
        }
    }
    text
}

fn unmodelled_effects(results: &[CaseResult]) -> String {
    let kind = CaseKind::UnmodelledEffect;
    if !has(results, kind) {
        return String::new();
    }
    let depends_on = of(results, kind).filter_map(|result| result.verdict.depends_on);
    rate("outside the catalogue: false positive", "<= 10 %", of(results, kind).map(has_wrong_name))
        + &rate("outside the catalogue: what it depends on is correct", ">= 60 %", depends_on)
}

fn several_effects(results: &[CaseResult]) -> String {
    let mut text = String::new();
    let all = |kind: CaseKind, good: fn(&EffectScore) -> bool| {
        let counted = of(results, kind).filter(|result| result.verdict.hits.iter().all(EffectScore::counts));
        counted.map(move |result| result.verdict.hits.iter().all(good))
    };
    if has(results, CaseKind::TwoEffects) {
        text += &rate("two effects: both reported", ">= 65 %", all(CaseKind::TwoEffects, |hit| hit.named));
        let scopes = all(CaseKind::TwoEffects, |hit| hit.named && hit.scope_right);
        text += &rate("two effects: both reported, scopes correct", "", scopes);
    }
    if has(results, CaseKind::FourEffects) {
        let kind = CaseKind::FourEffects;
        text += &rate("four effects: all reported", ">= 60 %", all(kind, |hit| hit.named));
        text += &rate("four effects: each", "", hits(results, kind).map(|hit| hit.named));
        text += &rate("four effects: false positive", "<= 10 %", of(results, kind).map(has_wrong_name));
    }
    text
}

fn walking_robots(results: &[CaseResult]) -> String {
    let kind = CaseKind::WalkingEffect;
    if !has(results, kind) {
        return String::new();
    }
    let label = "walking without motion capture";
    let mut text = rate(&format!("{label}: top-1 correct"), ">= 70 %", hits(results, kind).map(|hit| hit.first));
    let effects: BTreeSet<&str> = hits(results, kind).map(|hit| hit.effect.as_str()).collect();
    for effect in effects {
        let outcomes = hits(results, kind).filter(|hit| hit.effect == effect).map(|hit| hit.first);
        text += &rate(&format!("{label}, {effect}: top-1 correct"), "", outcomes);
    }
    text += &rate(&format!("{label}: scope correct"), "", hits(results, kind).map(|hit| hit.scope_right));
    text + &rate(&format!("{label}: additional false positive"), "", of(results, kind).map(has_wrong_name))
}

fn confusable_effects(results: &[CaseResult]) -> String {
    let (kind, label) = (CaseKind::ConfusableEffect, "one effect with confounders, positions only");
    if !has(results, kind) {
        return String::new();
    }
    rate(&format!("{label}: top-1 correct"), "", hits(results, kind).map(|hit| hit.first))
        + &rate(&format!("{label}: additional false positive"), "", of(results, kind).map(has_wrong_name))
        + &name_set(label, hits(results, kind))
}
