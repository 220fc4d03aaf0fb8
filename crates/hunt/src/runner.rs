//! Runs one case: simulates its log, diagnoses it in another process and scores the findings.

use std::fs::File;
use std::path::Path;
use std::process::{Child, ExitStatus};
use std::time::{Duration, Instant};

use twinstep_diagnose::{Diagnosis, RmsErrors, held_out_rows, true_law_gain};
use twinstep_effects::ModelFile;
use twinstep_identify::{RecordError, evaluate};
use twinstep_logs::Log;
use twinstep_model::{RobotModel, go2};
use twinstep_sim::BatchRollout;

use crate::draw::Case;
use crate::ground_truth::Take;
use crate::score::judge;
use crate::{CaseResult, Diagnose, HuntError, Plant, Suite, at, failed, ground_truth};

/// Interval at which a running diagnosis is polled.
const POLL_INTERVAL: Duration = Duration::from_millis(20);
/// Exit code of a command with invalid input. Such a diagnosis cannot start, which ends the blind test.
const BAD_INPUT: i32 = 2;

/// Running blind test.
pub struct BlindTest<'a> {
    /// The robot of the cases.
    pub plant: Plant,
    /// What the cases hide.
    pub suite: Suite,
    /// Folder of the results.
    pub out: &'a Path,
    /// Diagnosing program.
    pub diagnose: &'a Diagnose,
    /// Returns true once the user has asked to stop.
    pub interrupted: crate::Interrupted<'a>,
    /// Simulator in which the true model is evaluated.
    pub simulator: BatchRollout,
}

/// Findings of a diagnosis or its error message, with its duration.
struct DiagnosisRun {
    findings: Result<Diagnosis, String>,
    seconds: f64,
}

impl BlindTest<'_> {
    /// Simulates, diagnoses and scores a case.
    pub fn run_case(&mut self, case: &Case) -> Result<CaseResult, HuntError> {
        let folder = self.out.join(format!("{:04}", case.number));
        let model = self.out.join("nominal.toml");
        twinstep_files::write(&model, ModelFile::default().to_toml()).map_err(at(&model))?;
        let log =
            ground_truth::log_of(case, self.plant, Take::First, &mut |_| !(self.interrupted)()).map_err(|error| {
                match error {
                    RecordError::Interrupted => HuntError::Interrupted,
                    error => failed(error),
                }
            })?;
        let path = folder.join("log");
        log.write(&path).map_err(failed)?;
        let DiagnosisRun { findings, seconds } = self.run_diagnosis(&path, &model, &folder)?;
        // Written after the diagnosis, so that it cannot have read the file.
        let truth = folder.join("truth.toml");
        twinstep_files::write(&truth, case.truth().to_toml()).map_err(at(&truth))?;
        let held_out = held_out_rows(&log);
        let mut errors = |robot: &RobotModel| {
            let found = evaluate(&log, robot, &mut self.simulator, |row| held_out[row]).map_err(failed)?;
            Ok(RmsErrors { torque_rmse_nm: found.torque_rmse_nm, q_rmse_rad: found.q_rmse_rad })
        };
        let nominal = errors(&go2())?;
        let truth = errors(&case.truth().robot_model().map_err(failed)?)?;
        let gains = self.true_law_gains(case, &log)?;
        Ok(CaseResult {
            seed: case.seed,
            case: case.number,
            plant: self.plant,
            suite: self.suite,
            kind: case.kind,
            setting: case.setting,
            outside: case.outside,
            mismatch: case.mismatch,
            nominal,
            truth,
            verdict: judge(case, findings.as_ref().ok(), [nominal, truth], &gains),
            error: findings.err(),
            seconds,
        })
    }

    /// Returns the log-likelihood gain of the true law of each hidden effect, with the others known [nat]; infinite if it cannot
    /// be computed.
    fn true_law_gains(&mut self, case: &Case, log: &Log) -> Result<Vec<f64>, HuntError> {
        let of_effect = |index: usize| {
            if (self.interrupted)() {
                return Err(HuntError::Interrupted);
            }
            let mut others = case.truth();
            let law = others.effects.remove(index);
            Ok(true_law_gain(vec![log.clone()], &others, &law, &mut self.simulator).unwrap_or(f64::INFINITY))
        };
        (0..case.hidden.len()).map(of_effect).collect()
    }

    /// Runs the diagnosis. Keeps its output in the folder of the case.
    fn run_diagnosis(&self, log: &Path, model: &Path, folder: &Path) -> Result<DiagnosisRun, HuntError> {
        let [stdout, stderr] = ["diagnosis.json", "diagnosis.txt"].map(|name| folder.join(name));
        let start = Instant::now();
        let mut command = (self.diagnose)(log, model, &folder.join("report"));
        let create = |path: &Path| File::create(path).map_err(failed);
        let spawned = command.stdout(create(&stdout)?).stderr(create(&stderr)?).spawn();
        let status = self.wait(spawned.map_err(failed)?)?;
        let seconds = start.elapsed().as_secs_f64();
        let stderr_text = std::fs::read_to_string(&stderr).map_err(failed)?.trim().to_owned();
        if status.code() == Some(BAD_INPUT) {
            return Err(HuntError::NoDiagnosis { log: log.to_owned(), message: stderr_text });
        }
        let findings = if status.success() {
            serde_json::from_str(&std::fs::read_to_string(&stdout).map_err(failed)?).map_err(|error| error.to_string())
        } else {
            Err(format!("{status}: {stderr_text}"))
        };
        Ok(DiagnosisRun { findings, seconds })
    }

    fn wait(&self, mut child: Child) -> Result<ExitStatus, HuntError> {
        loop {
            if let Some(status) = child.try_wait().map_err(failed)? {
                // Ctrl-C reaches both processes; an interrupted diagnosis is not a result.
                return if (self.interrupted)() { Err(HuntError::Interrupted) } else { Ok(status) };
            }
            if (self.interrupted)() {
                child.kill().and_then(|()| child.wait()).map_err(failed)?;
                return Err(HuntError::Interrupted);
            }
            std::thread::sleep(POLL_INTERVAL);
        }
    }
}
