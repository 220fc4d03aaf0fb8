//! Table of rates and confusion matrix of a blind test, in Markdown.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;

use crate::CaseResult;
use crate::base_schedule::LogLength;
use crate::draw::CaseKind;
use crate::mismatch::Mismatch;
use crate::score::{EffectScore, ErrorReduction};

/// Label in the matrix for no hidden effect and for no reported cause.
const NONE: &str = "(none)";

/// Returns the results of a blind test.
pub fn text(results: &[CaseResult]) -> String {
    let mut text = format!("{} cases\n\n", results.len());
    text += &rates(results);
    text += &numbers(results);
    text += "\nFirst cause reported (columns) by hidden effect (rows), number of cases; \"(outside)\" is an effect \
             outside the\ncatalogue:\n\n";
    text + &matrix(results)
}

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
fn wilson(hits: usize, count: usize) -> [f64; 2] {
    const Z: f64 = 1.959_964;
    let (n, rate) = (count as f64, hits as f64 / count as f64);
    let middle = rate + Z * Z / (2.0 * n);
    let reach = Z * (rate * (1.0 - rate) / n + Z * Z / (4.0 * n * n)).sqrt();
    [middle - reach, middle + reach].map(|end| (end / (1.0 + Z * Z / n)).clamp(0.0, 1.0))
}

fn rates(results: &[CaseResult]) -> String {
    let parts =
        [single_effects, healthy_robots, unmodelled_effects, several_effects, walking_robots, confusable_effects];
    let mut text = "| | goal | rate | 95 % interval |\n|---|---|---|---|\n".to_owned();
    text.extend(parts.map(|rows| rows(results)));
    let sizes = results.iter().flat_map(|result| &result.verdict.hits).filter_map(|hit| hit.size);
    text += &rate("size within its 95 % interval", "88 to 99 %", sizes.map(|size| size.covered));
    text + &rate("diagnosis failed", "none", results.iter().map(|result| result.error.is_some()))
}

fn of(results: &[CaseResult], kind: CaseKind) -> impl Iterator<Item = &CaseResult> {
    results.iter().filter(move |result| result.kind == kind)
}

fn hits(results: &[CaseResult], kind: CaseKind) -> impl Iterator<Item = &EffectScore> {
    of(results, kind).flat_map(|result| &result.verdict.hits)
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
        of(results, kind).map(move |result| result.verdict.hits.iter().all(good))
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

fn numbers(results: &[CaseResult]) -> String {
    let sizes = results.iter().flat_map(|result| &result.verdict.hits).filter_map(|hit| hit.size);
    let removed =
        |of: fn(&ErrorReduction) -> Option<f64>| results.iter().filter_map(move |result| of(&result.verdict.removed));
    let seconds = results.iter().map(|result| result.seconds);
    let line = |label: &str, goal: &str, value: Option<f64>, unit: &str, scale: f64| {
        let value = value.map_or("no case".to_owned(), |value| format!("{:.1} {unit}", scale * value));
        format!("| {label} | {goal} | {value} | |\n")
    };
    let share = "% of the true model's reduction";
    let mut text = line("median error of size", "<= 10 %", median(sizes.map(|size| size.error)), "%", 100.0);
    for (label, shares) in [
        ("held-out torque error removed, median", median(removed(|removed| removed.torque))),
        ("held-out motion error removed, median", median(removed(|removed| removed.motion))),
    ] {
        text += &line(label, ">= 85 %", shares, share, 100.0);
    }
    text += &line("time of a diagnosis, median", "", median(seconds.clone()), "s", 1.0);
    text += &line("time of a diagnosis, longest", "", seconds.reduce(f64::max), "s", 1.0);
    let penalty = results.iter().map(penalty).sum::<usize>() as f64 / results.len().max(1) as f64;
    let label = "penalty per case: 1 for each effect not reported, 2 for each false positive";
    text + &line(label, "", Some(penalty), "", 1.0)
}

fn penalty(result: &CaseResult) -> usize {
    result.verdict.hits.iter().filter(|hit| !hit.named).count() + 2 * result.verdict.wrong_names
}

fn median(values: impl Iterator<Item = f64>) -> Option<f64> {
    let mut values: Vec<_> = values.collect();
    values.sort_by(f64::total_cmp);
    let (half, odd) = (values.len() / 2, values.len() % 2 == 1);
    let upper = *values.get(half)?;
    Some(if odd { upper } else { 0.5 * (values[half - 1] + upper) })
}

/// Returns the confusion matrix: how often each effect was reported first, by hidden effect. Omits cases with several
/// effects.
fn matrix(results: &[CaseResult]) -> String {
    let mut counts = BTreeMap::<(&str, &str), usize>::new();
    let several = [CaseKind::TwoEffects, CaseKind::FourEffects];
    for result in results.iter().filter(|result| !several.contains(&result.kind)) {
        let hidden = match result.kind {
            CaseKind::Healthy => NONE,
            CaseKind::UnmodelledEffect => "(outside)",
            _ => result.verdict.hits.first().map_or(NONE, |hit| &hit.effect),
        };
        let named = result.verdict.named.first().and_then(|named| named.split('@').next()).unwrap_or(NONE);
        *counts.entry((hidden, named)).or_default() += 1;
    }
    let rows: BTreeSet<_> = counts.keys().map(|(hidden, _)| *hidden).collect();
    let columns: BTreeSet<_> = counts.keys().map(|(_, named)| *named).collect();
    let mut text = "| hidden".to_owned();
    for named in &columns {
        let _ = write!(text, " | {named}");
    }
    let _ = writeln!(text, " |\n|---{}|", "|---".repeat(columns.len()));
    for hidden in rows {
        let _ = write!(text, "| {hidden}");
        for named in &columns {
            let count = counts.get(&(hidden, *named)).map_or(String::new(), ToString::to_string);
            let _ = write!(text, " | {count}");
        }
        text += " |\n";
    }
    text
}

#[cfg(test)]
mod tests {
    use expect_test::expect;
    use twinstep_diagnose::RmsErrors;

    use super::*;
    use crate::base_schedule::BaseSchedule;
    use crate::draw::LogSetup;
    use crate::score::{Score, Size};

    fn result(kind: CaseKind, hidden: &[&str], named: &[&str]) -> CaseResult {
        let hit = |name: &&str| EffectScore {
            effect: (*name).to_owned(),
            scope: "all".to_owned(),
            named: named.contains(name),
            first: named.first() == Some(name),
            ambiguous: false,
            in_top_3: named.contains(name),
            in_set: named.contains(name),
            set_size: usize::from(!named.is_empty()),
            scope_right: named.contains(name),
            size: named.contains(name).then_some(Size { covered: true, error: 0.04 }),
        };
        let verdict = Score {
            named: named.iter().map(|name| format!("{name}@all")).collect(),
            hits: hidden.iter().map(hit).collect(),
            wrong_names: named.iter().filter(|name| !hidden.contains(name)).count(),
            depends_on: (kind == CaseKind::UnmodelledEffect).then_some(true),
            removed: ErrorReduction { torque: None, motion: Some(0.9) },
        };
        let setting = LogSetup::with_torque(BaseSchedule::Fixed);
        let (nominal, truth) = (RmsErrors::default(), RmsErrors::default());
        CaseResult {
            plant: crate::Plant::Rapier,
            suite: crate::Suite::Mixed,
            seed: 0,
            case: 0,
            kind,
            setting,
            outside: None,
            mismatch: None,
            nominal,
            truth,
            verdict,
            error: None,
            seconds: 12.0,
        }
    }

    #[test]
    fn interval_is_that_of_wilson() {
        let [low, high] = wilson(9, 10);
        assert!((low - 0.5958).abs() < 1e-4 && (high - 0.9821).abs() < 1e-4, "{low} {high}");
        assert_eq!(wilson(0, 20)[0], 0.0);
    }

    #[test]
    fn five_cases_give_this_table() {
        let results = [
            result(CaseKind::LargeEffect, &["armature"], &["armature"]),
            result(CaseKind::LargeEffect, &["drive_lag"], &["torque_delay"]),
            result(CaseKind::Healthy, &[], &[]),
            result(CaseKind::UnmodelledEffect, &[], &[]),
            result(CaseKind::TwoEffects, &["armature", "payload"], &["payload"]),
        ];
        expect![[r#"
            5 cases

            | | goal | rate | 95 % interval |
            |---|---|---|---|
            | half the range or more: top-1 correct | >= 90 % | 1 of 2: 50 % | 9 to 91 % |
            | half the range or more: listed as indistinguishable |  | 0 of 2: 0 % | 0 to 66 % |
            | half the range or more: top-3 correct | >= 97 % | 1 of 2: 50 % | 9 to 91 % |
            | half the range or more: scope correct | >= 90 % | 1 of 2: 50 % | 9 to 91 % |
            | half the range or more: additional false positive |  | 1 of 2: 50 % | 9 to 91 % |
            | one effect: within the set of names | >= 90 % | 1 of 2: 50 % | 9 to 91 % |
            | one effect: mean size of the set | <= 2.5 | 1.0 | |
            | nothing hidden: false positive | <= 7 % | 0 of 1: 0 % | 0 to 79 % |
            | outside the catalogue: false positive | <= 10 % | 0 of 1: 0 % | 0 to 79 % |
            | outside the catalogue: what it depends on is correct | >= 60 % | 1 of 1: 100 % | 21 to 100 % |
            | two effects: both reported | >= 65 % | 0 of 1: 0 % | 0 to 79 % |
            | two effects: both reported, scopes correct |  | 0 of 1: 0 % | 0 to 79 % |
            | size within its 95 % interval | 88 to 99 % | 2 of 2: 100 % | 34 to 100 % |
            | diagnosis failed | none | 0 of 5: 0 % | 0 to 43 % |
            | median error of size | <= 10 % | 4.0 % | |
            | held-out torque error removed, median | >= 85 % | no case | |
            | held-out motion error removed, median | >= 85 % | 90.0 % of the true model's reduction | |
            | time of a diagnosis, median |  | 12.0 s | |
            | time of a diagnosis, longest |  | 12.0 s | |
            | penalty per case: 1 for each effect not reported, 2 for each false positive |  | 0.8  | |

            First cause reported (columns) by hidden effect (rows), number of cases; "(outside)" is an effect outside the
            catalogue:

            | hidden | (none) | armature | torque_delay |
            |---|---|---|---|
            | (none) | 1 |  |  |
            | (outside) | 1 |  |  |
            | armature |  | 1 |  |
            | drive_lag |  |  | 1 |
        "#]]
        .assert_eq(&text(&results));
    }
}
