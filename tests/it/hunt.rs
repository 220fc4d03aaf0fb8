//! `twinstep hunt` as a process: a blind test of diagnosis with a fixed seed.

use serde_json::Value;

use crate::identify::twinstep;

/// Number of cases. The diagnosis was developed with seed 1, so this test is not an evaluation.
const CASES: &str = "3";

#[test]
fn a_large_hidden_effect_is_found_and_no_other_is_named_in_three_cases() {
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
    // The balance of a robot that stands hardly shows 0.8 kg.
    assert_eq!(payload["effect"], "payload", "{scores:#?}");
    let wrong: Vec<_> = scores.iter().map(|score| score["wrong_names"].as_u64().unwrap()).collect();
    assert_eq!(wrong, [0, 0, 0], "{scores:#?}");
}
