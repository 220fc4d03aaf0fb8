//! `twinstep hunt` as a process: a blind test of diagnosis with a fixed seed.

use serde_json::Value;

use crate::identify::twinstep;

/// Number of cases. The diagnosis was developed with seed 1, so this test is not an evaluation.
const CASES: &str = "3";

#[test]
fn hidden_effects_of_three_cases_are_found_or_among_what_the_log_cannot_tell_apart() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("hunt");
    let output = twinstep(&["hunt", "--cases", CASES, "--seed", "1", "--out", out.to_str().unwrap()]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let cases = std::fs::read_to_string(out.join("cases.jsonl")).unwrap();
    let scores: Vec<Value> =
        cases.lines().map(|line| serde_json::from_str::<Value>(line).unwrap()["verdict"].take()).collect();
    assert_eq!(scores.len(), 3);
    let hits: Vec<&Value> = scores.iter().flat_map(|score| score["hits"].as_array().unwrap()).collect();
    let [shift, payload] = hits.as_slice() else { panic!("{scores:#?}") };
    assert!(shift["first"] == true && shift["scope_right"] == true && shift["size"]["covered"] == true, "{scores:#?}");
    // Without a torque sensor, a payload of 0.8 kg and a shifted centre of mass are as likely.
    assert!(payload["ambiguous"] == true && payload["in_set"] == true, "{scores:#?}");
    let wrong: Vec<_> = scores.iter().map(|score| score["wrong_names"].as_u64().unwrap()).collect();
    assert_eq!(wrong, [0, 0, 1], "{scores:#?}");
}
