//! Numbers of an iteration of U2E: robot time, and what the ensembles predict for the logs.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use twinstep_agent::RunSummary;
use twinstep_ensemble::{DataSet, Ensemble, Sequence, Split};
use twinstep_logs::Log;
use twinstep_model::{Joint, go2};

use crate::cross_evaluation::evaluated_rows;
use crate::failure::{Failure, input};
use crate::observer::Observer;
use crate::open_log::open_log;

/// Share of a joint's torque limit from which on a torque counts as at the limit.
const AT_LIMIT: f64 = 0.9;

/// What the collection of a log cost.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Collection {
    /// Duration [s].
    pub seconds: f64,
    /// Number of falls.
    pub falls: u64,
    /// Share of the torques, over rows and joints, that are at least 90 % of the joint's limit.
    pub torque_limit_share: f64,
}

impl Collection {
    /// Returns the cost of a run and its log.
    pub fn new(run: &RunSummary, log: &Path, observer: &Observer) -> Result<Self, Failure> {
        let (log, limits) = (open_log(log, observer)?, go2().torque_limits());
        let (mut at_limit, mut count) = (0, 0);
        for joint in Joint::ALL {
            let limit = AT_LIMIT * f64::from(limits[joint.index()]);
            let torques = log.tau_measured(joint.name()).unwrap_or_default();
            at_limit += torques.iter().filter(|torque| torque.abs() >= limit).count();
            count += torques.len();
        }
        let torque_limit_share = at_limit as f64 / count.max(1) as f64;
        Ok(Self { seconds: run.seconds, falls: run.falls, torque_limit_share })
    }
}

/// Errors of an ensemble on a log.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Errors {
    /// Torque RMSE of the members' mean [N·m].
    pub torque_rmse_nm: f64,
    /// Mean epistemic uncertainty [nat].
    pub uncertainty_nat: f64,
}

/// Numbers of an iteration.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Evaluation {
    /// Name of the iteration.
    pub name: String,
    /// What its log cost.
    pub collection: Collection,
    /// Mean uncertainty of the new log, all rows, by the ensemble before it [nat]. `None` for the first log.
    pub uncertainty: Option<f64>,
    /// Errors of the earlier ensembles on the test split of the new log.
    pub earlier_on_new_log: Vec<Option<Errors>>,
    /// Errors of the new ensemble on the test split of each log. `None` for a log that is too short for one.
    pub on_logs: Vec<Option<Errors>>,
    /// Errors of the new ensemble on all rows of the held-out log, if there is one.
    pub held_out: Option<Errors>,
}

impl Evaluation {
    /// Evaluates `ensembles`, the last of which is new, on `logs`, the last of which is new.
    pub fn new(
        name: &str,
        collection: Collection,
        ensembles: &[PathBuf],
        logs: &[PathBuf],
        held_out: Option<&Path>,
        observer: &Observer,
    ) -> Result<Self, Failure> {
        let read = ensembles.iter().map(|path| Ensemble::read(path).map_err(input));
        let ensembles: Vec<Ensemble> = read.collect::<Result<_, _>>()?;
        let (new, earlier) = ensembles.split_last().expect("there is an ensemble");
        let open = |path: &PathBuf| Ok((path.display().to_string(), open_log(path, observer)?));
        let logs: Vec<(String, Log)> = logs.iter().map(open).collect::<Result<_, Failure>>()?;
        // The blocks have the same splits as in the training of the new ensemble.
        let data = DataSet::new(&logs).map_err(input)?;
        let test = |log: usize| data.runs(Split::Test).filter(move |run| run.log == log);
        let newest = logs.len() - 1;
        let all = || data.all_runs().filter(|run| run.log == newest);
        let held_out =
            held_out.map(|path| Ok::<_, Failure>(vec![(path.display().to_string(), open_log(path, observer)?)]));
        let held_out = held_out.transpose()?.map(|log| DataSet::new(&log).map_err(input)).transpose()?;
        Ok(Self {
            name: name.to_owned(),
            collection,
            uncertainty: earlier.last().and_then(|last| Some(errors(last, all(), data.dt)?.uncertainty_nat)),
            earlier_on_new_log: earlier.iter().map(|ensemble| errors(ensemble, test(newest), data.dt)).collect(),
            on_logs: (0..logs.len()).map(|log| errors(new, test(log), data.dt)).collect(),
            held_out: held_out.and_then(|held_out| errors(new, held_out.all_runs(), held_out.dt)),
        })
    }
}

/// Returns the errors of an ensemble. Returns `None` if no row has a prediction.
fn errors<'a>(ensemble: &Ensemble, runs: impl Iterator<Item = &'a Sequence> + Clone, dt: f64) -> Option<Errors> {
    let (mut squares, mut uncertainty, mut count) = (0.0_f64, 0.0, 0.0);
    for (run, rows) in runs.clone().zip(ensemble.predict(runs)) {
        for [_, torque, mean, euf] in evaluated_rows(run, &rows, dt) {
            squares += (torque - mean).powi(2);
            uncertainty += euf;
            count += 1.0;
        }
    }
    (count > 0.0).then(|| Errors { torque_rmse_nm: (squares / count).sqrt(), uncertainty_nat: uncertainty / count })
}
