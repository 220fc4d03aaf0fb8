//! A part of the fault campaign of the robot.

use rayon::prelude::*;
use twinstep_robot::State;
use twinstep_tests::robot_campaign::table::{self, Injection};
use twinstep_tests::robot_campaign::{report, sequence};

#[test]
fn faults_have_the_specified_reaction() {
    let lines = ["stale 100", "messages lost", "heat FL_calf 90", "controller on"].map(Injection::Line);
    let states = [State::Run, State::Observe, State::Damp, State::StandUp, State::Sit];
    let injections = lines.into_iter().chain([Injection::StopRequested, Injection::ActionsMissing]);
    let pairs: Vec<_> = injections.flat_map(|injection| states.map(|state| (injection, state))).collect();
    let cells: Vec<_> = pairs.into_par_iter().map(|(injection, state)| table::run(injection, state)).collect();
    assert_eq!(report::violations(&cells), Vec::<String>::new());
    let (_, ms) = cells[0].fault.unwrap();
    assert!((20..=40).contains(&ms), "stale states are a fault after {ms} ms");
}

#[test]
fn random_sequences_violate_no_invariant() {
    let results: Vec<_> = (0..20).into_par_iter().map(|index| sequence::run(11, index)).collect();
    let mut sum = sequence::Tally::default();
    for tally in results {
        sum.add(tally);
    }
    let found = sum.counterexample.as_ref().map(|found| report::counterexample(11, found));
    assert_eq!(found, None);
    assert!(sum.steps.len() == State::ALL.len() && sum.faults.len() > 5, "{sum:?}");
}
