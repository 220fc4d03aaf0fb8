//! Inference of one row for many robots on one core, with states carried from row to row.

use std::path::Path;

use twinstep_ensemble::{BurnInference, Inference};
use twinstep_model::NUM_JOINTS;

use super::torch::{Learning, Setup, Torch, name};
use super::{HIDDEN, MEMBERS, ensemble};
use crate::Measurement;
use crate::error::{BenchError, Interrupted, check};
use crate::throughput::{WINDOWS, measure as pace, median_of};

/// Numbers of robots of a query.
const ROBOTS: [usize; 4] = [1, 64, 1024, 4096];

/// Measures the time of a query [µs] with one member, and with six and their uncertainty.
///
/// Windows of Twinstep, PyTorch and burn alternate.
pub fn measure(python: &Path, window_s: f64, interrupted: Interrupted) -> Result<Vec<Measurement>, BenchError> {
    let (members, robots, learning) = (&[1, MEMBERS], &ROBOTS, Learning::default());
    let mut torch = Torch::start(python, &Setup { hidden: HIDDEN, members, robots, learning, window_s });
    let mut rows = Vec::new();
    for members in [1, MEMBERS] {
        for robots in ROBOTS {
            check(interrupted)?;
            rows.extend(query(members, robots, &mut torch, window_s)?);
        }
    }
    Ok(rows)
}

fn query(members: usize, robots: usize, torch: &mut Torch, window_s: f64) -> Result<Vec<Measurement>, BenchError> {
    let ensemble = ensemble(members);
    let (mut ours, mut burns) = (Inference::new(&ensemble, robots), BurnInference::new(&ensemble, robots));
    let mut time = 0;
    let mut errors = || {
        time += 1;
        errors(robots, time)
    };
    let torch_name = name(members, robots);
    let [mut own, mut torches, mut burn_times] = [(); 3].map(|()| Vec::new());
    for _ in 0..WINDOWS {
        own.push(median_us(window_s, || {
            ours.step(&errors());
            if members > 1 {
                std::hint::black_box(ours.epistemic_uncertainty());
            }
        })?);
        burn_times.push(median_us(window_s, || drop(std::hint::black_box(burns.hear(&errors()))))?);
        if torch.has(&torch_name) {
            torches.push(torch.window(&torch_name)?);
        }
    }
    let (own, burn_times) = (median_of(own), median_of(burn_times));
    let what = if members == 1 { "one member".to_owned() } else { format!("{members} members with uncertainty") };
    let case = format!("query of {what}, {robots} robots");
    let row = |case: String, value: f64, reference: Option<(&str, f64)>| Measurement {
        case,
        value,
        unit: "us",
        reference: reference.map(|(name, _)| name.to_owned()),
        ratio: reference.map(|(_, theirs)| theirs / value),
    };
    let mut rows = vec![row(case.clone(), own, Some(("burn's operations", burn_times)))];
    if !torches.is_empty() {
        rows.push(row(case.clone(), own, Some(("PyTorch, one thread", median_of(torches.clone())))));
        rows.push(row(format!("{case}, PyTorch, one thread"), median_of(torches), None));
    }
    // burn's time is that of the networks only: it does not compute the uncertainty.
    rows.push(row(format!("{case}, burn's operations (without uncertainty)"), burn_times, None));
    Ok(rows)
}

fn median_us(window_s: f64, mut once: impl FnMut()) -> Result<f64, BenchError> {
    let once = || {
        once();
        Ok(())
    };
    pace(window_s, once).map(|pace| pace.median_us)
}

/// Returns ξ of robots with swinging joints.
fn errors(robots: usize, time: usize) -> Vec<[[f64; 2]; NUM_JOINTS]> {
    let phase = 0.05 * time as f64;
    let one: [[f64; 2]; NUM_JOINTS] = std::array::from_fn(|joint| {
        let phase = phase + joint as f64;
        [0.1 * phase.sin(), phase.cos()]
    });
    vec![one; robots]
}
