//! 40 faults injected into real processes. `target/release/faults --faults 1000` injects more.

use std::sync::atomic::AtomicBool;

use twinstep_tests::fault::Fault;
use twinstep_tests::fault_injection::{self, FaultPlan, FaultReport};
use twinstep_tests::test_bed::TestBedConfig;

fn inject(faults: usize, lanes: usize, server_arguments: &[&str]) -> FaultReport {
    let plan = FaultPlan {
        commands: TestBedConfig {
            program: env!("CARGO_BIN_EXE_faults").into(),
            server: server_arguments.iter().map(|argument| (*argument).to_owned()).collect(),
            client: None,
        },
        faults,
        kinds: Fault::ALL.to_vec(),
        lanes,
        seed: 1,
    };
    fault_injection::run(&plan, &AtomicBool::new(false), |_| ())
}

#[test]
fn no_fault_causes_a_duplicate_a_skipped_or_an_invented_step() {
    let tally = inject(40, 8, &[]);
    println!("{tally}");
    assert_eq!(tally.total(), 40);
    assert_eq!(tally.injected.len(), 10, "every kind of fault was injected");
    assert!(tally.failures.is_empty() && tally.unfinished.is_empty(), "{tally:#?}");
}

#[test]
fn server_that_executes_a_step_twice_is_detected() {
    let tally = inject(2, 1, &["--duplicate-step-every", "5"]);
    assert!(tally.failures.iter().any(|(_, evidence)| evidence.starts_with("violation")), "{:#?}", tally.failures);
}
