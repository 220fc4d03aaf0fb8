//! A short soak test. `target/release/soak --minutes 30` is the long one.

use std::process::Command;

use twinstep_tests::python::Programs;

#[test]
fn server_releases_what_its_clients_used() {
    let twinstep = Programs::beside(env!("CARGO_BIN_EXE_soak")).unwrap().twinstep();
    let arguments = ["--minutes", "0.3", "--lanes", "4", "--twinstep"];
    let output = Command::new(env!("CARGO_BIN_EXE_soak")).args(arguments).arg(twinstep).output().unwrap();
    let text = String::from_utf8_lossy(&output.stdout);
    println!("{text}{}", String::from_utf8_lossy(&output.stderr));
    assert!(output.status.success(), "{text}");
    assert!(text.contains("| environments that are not free | 0 | | 0 |"));
}
