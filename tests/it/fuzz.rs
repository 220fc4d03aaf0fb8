//! A short run of `target/release/fuzz`: 2,000 inputs of each format.

use std::process::Command;

#[test]
fn changed_messages_and_files_are_read_or_refused_within_their_memory_limit() {
    let folder = tempfile::tempdir().unwrap();
    let arguments = ["--inputs", "2000", "--seed", "7", "--out"];
    let output = Command::new(env!("CARGO_BIN_EXE_fuzz")).args(arguments).arg(folder.path()).output().unwrap();
    let table = String::from_utf8_lossy(&output.stdout);
    println!("{table}{}", String::from_utf8_lossy(&output.stderr));
    assert!(output.status.success(), "an input was found");
    assert!(table.contains("| all messages | 30000 |") && table.contains("| all files | 46200 |"));
}

#[test]
fn equal_seeds_give_equal_results() {
    let run = || {
        let folder = tempfile::tempdir().unwrap();
        let arguments = ["--inputs", "500", "--format", "step_reply", "--format", "log_csv", "--out"];
        let output = Command::new(env!("CARGO_BIN_EXE_fuzz")).args(arguments).arg(folder.path()).output().unwrap();
        let text = String::from_utf8(output.stdout).unwrap();
        let line = |name: &str| {
            let line = text.lines().find(|line| line.starts_with(name)).unwrap();
            // Number of inputs, shares of decoded and of accepted inputs.
            [2, 4, 5].map(|cell| line.split('|').nth(cell).unwrap().to_owned())
        };
        [line("| step_reply"), line("| log_csv")]
    };
    assert_eq!(run(), run());
}
