//! Table of rates and confusion matrix of a blind test, in Markdown.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;

use crate::CaseResult;
use crate::draw::CaseKind;
use crate::rates::rates;
use crate::score::{ErrorReduction, LEAST_GAIN};

/// Label in the matrix for no hidden effect and for no reported cause.
const NONE: &str = "(none)";

/// Returns the results of a blind test.
pub fn text(results: &[CaseResult]) -> String {
    let mut text = format!("{} cases\n\n", results.len());
    text += &rates(results);
    text += &numbers(results);
    text += "\nFirst cause reported (columns) by hidden effect (rows), number of cases; \"(outside)\" is an effect \
             outside the\ncatalogue:\n\n";
    text += &matrix(results);
    text + &not_counted(results)
}

/// Returns the list of hidden effects that are not evident in their logs.
fn not_counted(results: &[CaseResult]) -> String {
    let mut text = String::new();
    for result in results {
        for hit in result.verdict.hits.iter().filter(|hit| !hit.counts()) {
            let _ = write!(text, "\n- case {}: {}@{}", result.case, hit.effect, hit.scope);
            let reported = if hit.named { "reported" } else { "not reported" };
            let _ = write!(text, ", {:.1} nat, {reported}", hit.true_law_gain);
        }
    }
    if text.is_empty() {
        return text;
    }
    format!(
        "\nNot evident: the true law, refitted with everything else known, gains less than {LEAST_GAIN:.0} nat:\n{text}\n"
    )
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
    result.verdict.hits.iter().filter(|hit| hit.counts() && !hit.named).count() + 2 * result.verdict.wrong_names
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
    use crate::log_setup::LogSetup;
    use crate::rates::wilson;
    use crate::score::{EffectScore, Score, Size};

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
            true_law_gain: if *name == "encoder_offset" { 3.0 } else { 80.0 },
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
    fn seven_cases_give_this_table() {
        let results = [
            result(CaseKind::LargeEffect, &["armature"], &["armature"]),
            result(CaseKind::LargeEffect, &["drive_lag"], &["torque_delay"]),
            result(CaseKind::LargeEffect, &["encoder_offset"], &[]),
            result(CaseKind::Healthy, &[], &[]),
            result(CaseKind::UnmodelledEffect, &[], &[]),
            result(CaseKind::TwoEffects, &["armature", "payload"], &["payload"]),
            result(CaseKind::TwoEffects, &["armature", "encoder_offset"], &["armature"]),
        ];
        expect![[r#"
            7 cases

            | | goal | rate | 95 % interval |
            |---|---|---|---|
            | half the range or more: top-1 correct | >= 90 % | 1 of 2: 50 % | 9 to 91 % |
            | half the range or more: listed as indistinguishable |  | 0 of 2: 0 % | 0 to 66 % |
            | half the range or more: top-3 correct | >= 97 % | 1 of 2: 50 % | 9 to 91 % |
            | half the range or more: scope correct | >= 90 % | 1 of 2: 50 % | 9 to 91 % |
            | half the range or more: additional false positive |  | 1 of 3: 33 % | 6 to 79 % |
            | one effect: within the set of names | >= 90 % | 1 of 2: 50 % | 9 to 91 % |
            | one effect: mean size of the set | <= 2.5 | 1.0 | |
            | nothing hidden: false positive | <= 7 % | 0 of 1: 0 % | 0 to 79 % |
            | outside the catalogue: false positive | <= 10 % | 0 of 1: 0 % | 0 to 79 % |
            | outside the catalogue: what it depends on is correct | >= 60 % | 1 of 1: 100 % | 21 to 100 % |
            | two effects: both reported | >= 65 % | 0 of 1: 0 % | 0 to 79 % |
            | two effects: both reported, scopes correct |  | 0 of 1: 0 % | 0 to 79 % |
            | hidden effect not evident in its log, left out above | <= 15 % | 2 of 7: 29 % | 8 to 64 % |
            | size within its 95 % interval | 88 to 99 % | 3 of 3: 100 % | 44 to 100 % |
            | diagnosis failed | none | 0 of 7: 0 % | 0 to 35 % |
            | median error of size | <= 10 % | 4.0 % | |
            | held-out torque error removed, median | >= 85 % | no case | |
            | held-out motion error removed, median | >= 85 % | 90.0 % of the true model's reduction | |
            | time of a diagnosis, median |  | 12.0 s | |
            | time of a diagnosis, longest |  | 12.0 s | |
            | penalty per case: 1 for each effect not reported, 2 for each false positive |  | 0.6  | |

            First cause reported (columns) by hidden effect (rows), number of cases; "(outside)" is an effect outside the
            catalogue:

            | hidden | (none) | armature | torque_delay |
            |---|---|---|---|
            | (none) | 1 |  |  |
            | (outside) | 1 |  |  |
            | armature |  | 1 |  |
            | drive_lag |  |  | 1 |
            | encoder_offset | 1 |  |  |

            Not evident: the true law, refitted with everything else known, gains less than 10 nat:

            - case 0: encoder_offset@all, 3.0 nat, not reported
            - case 0: encoder_offset@all, 3.0 nat, not reported
        "#]]
        .assert_eq(&text(&results));
    }
}
