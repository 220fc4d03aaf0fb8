//! The game of hidden effects, through the real processes: a fixed hand of cases that decides.

use serde_json::Value;

use crate::identify::twinstep;

/// Of seed 1, which rules were developed with: a shift of the centre of mass, nothing, a payload and a shift at a fifth of
/// their ranges, a limit of speed, and a dead band, which no effect of the catalogue is.
const CASES: &str = "6";

#[test]
fn what_is_hidden_in_a_fixed_hand_of_cases_is_named_first_and_nothing_else_is() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("hunt");
    let output = twinstep(&["hunt", "--cases", CASES, "--seed", "1", "--out", out.to_str().unwrap()]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let ledger = std::fs::read_to_string(out.join("cases.jsonl")).unwrap();
    let verdicts: Vec<Value> =
        ledger.lines().map(|line| serde_json::from_str::<Value>(line).unwrap()["verdict"].take()).collect();
    assert_eq!(verdicts.len(), 6);
    let hits: Vec<&Value> = verdicts.iter().flat_map(|verdict| verdict["hits"].as_array().unwrap()).collect();
    let right = hits.iter().filter(|hit| hit["first"] == true && hit["scope_right"] == true).count();
    assert_eq!((right, hits.len()), (4, 4), "{verdicts:#?}");
    let wrong: u64 = verdicts.iter().map(|verdict| verdict["wrong_names"].as_u64().unwrap()).sum();
    assert_eq!(wrong, 0, "{verdicts:#?}");
}
