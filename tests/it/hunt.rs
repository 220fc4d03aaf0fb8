//! `twinstep hunt` as a process: a blind test of diagnosis with a fixed seed.

use serde_json::Value;

use crate::identify::twinstep;

/// Number of cases. The diagnosis was developed with seed 1, so this test is not an evaluation.
const CASES: &str = "3";

#[test]
fn hidden_effects_of_three_cases_are_found_first_and_nothing_else_is() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("hunt");
    let output = twinstep(&["hunt", "--cases", CASES, "--seed", "1", "--out", out.to_str().unwrap()]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let cases = std::fs::read_to_string(out.join("cases.jsonl")).unwrap();
    let scores: Vec<Value> =
        cases.lines().map(|line| serde_json::from_str::<Value>(line).unwrap()["verdict"].take()).collect();
    assert_eq!(scores.len(), 3);
    let hits: Vec<&Value> = scores.iter().flat_map(|score| score["hits"].as_array().unwrap()).collect();
    let right = hits.iter().filter(|hit| hit["first"] == true && hit["scope_right"] == true).count();
    assert_eq!((right, hits.len()), (2, 2), "{scores:#?}");
    let covered = hits.iter().filter(|hit| hit["size"]["covered"] == true).count();
    assert_eq!(covered, 2, "95 % intervals: {scores:#?}");
    let wrong: u64 = scores.iter().map(|score| score["wrong_names"].as_u64().unwrap()).sum();
    assert_eq!(wrong, 0, "{scores:#?}");
}
