//! One case of a game: a log is made, another process diagnoses it, and its words are judged.

use std::fs::File;
use std::path::Path;
use std::process::{Child, ExitStatus};
use std::time::{Duration, Instant};

use twinstep_diagnose::{Diagnosis, RmsErrors};
use twinstep_effects::ModelFile;
use twinstep_identify::{RecordError, evaluate};
use twinstep_model::{RobotModel, go2};
use twinstep_sim::BatchRollout;

use crate::draw::Case;
use crate::score::judge;
use crate::{CaseResult, Diagnose, HuntError, at, failed, ground_truth};

/// How often a running diagnosis is looked after.
const LOOK: Duration = Duration::from_millis(20);
/// How a command ends whose input is at fault; a diagnosis that cannot even start ends the game.
const BAD_INPUT: i32 = 2;

/// A game that is played.
pub struct BlindTest<'a> {
    /// Where it is kept.
    pub out: &'a Path,
    /// What diagnoses.
    pub diagnose: &'a Diagnose,
    /// What may end it.
    pub interrupted: crate::Interrupted<'a>,
    /// What the truth is evaluated in.
    pub simulator: BatchRollout,
}

/// What a diagnosis said, or complained of.
struct DiagnosisRun {
    said: Result<Diagnosis, String>,
    seconds: f64,
}

impl BlindTest<'_> {
    /// Hides, diagnoses and judges.
    pub fn run_case(&mut self, case: &Case) -> Result<CaseResult, HuntError> {
        let folder = self.out.join(format!("{:04}", case.number));
        let model = self.out.join("nominal.toml");
        std::fs::write(&model, ModelFile::default().to_toml()).map_err(at(&model))?;
        let log = ground_truth::log_of(case, &mut |_| !(self.interrupted)()).map_err(|error| match error {
            RecordError::Interrupted => HuntError::Interrupted,
            error => failed(error),
        })?;
        let path = folder.join("log");
        log.write(&path).map_err(failed)?;
        let DiagnosisRun { said, seconds } = self.answer(&path, &model, &folder)?;
        // Only now: nobody can have read it before.
        let truth = folder.join("truth.toml");
        std::fs::write(&truth, case.truth().to_toml()).map_err(at(&truth))?;
        let mut errors = |robot: &RobotModel| {
            let found = evaluate(&log, robot, &mut self.simulator, |_| true).map_err(failed)?;
            Ok(RmsErrors { torque_rmse_nm: found.torque_rmse_nm, q_rmse_rad: found.q_rmse_rad })
        };
        let nominal = errors(&go2())?;
        let truth = errors(&case.truth().robot_model().map_err(failed)?)?;
        Ok(CaseResult {
            seed: case.seed,
            case: case.number,
            kind: case.kind,
            setting: case.setting,
            outside: case.outside,
            nominal,
            truth,
            verdict: judge(case, said.as_ref().ok(), [nominal, truth]),
            error: said.err(),
            seconds,
        })
    }

    /// Lets the diagnosis run; its words are kept beside the log.
    fn answer(&self, log: &Path, model: &Path, folder: &Path) -> Result<DiagnosisRun, HuntError> {
        let [stdout, stderr] = ["diagnosis.json", "diagnosis.txt"].map(|name| folder.join(name));
        let start = Instant::now();
        let mut command = (self.diagnose)(log, model, &folder.join("report"));
        let create = |path: &Path| File::create(path).map_err(failed);
        let spawned = command.stdout(create(&stdout)?).stderr(create(&stderr)?).spawn();
        let status = self.wait(spawned.map_err(failed)?)?;
        let seconds = start.elapsed().as_secs_f64();
        let complaint = std::fs::read_to_string(&stderr).map_err(failed)?.trim().to_owned();
        if status.code() == Some(BAD_INPUT) {
            return Err(HuntError::NoDiagnosis { log: log.to_owned(), message: complaint });
        }
        let said = if status.success() {
            serde_json::from_str(&std::fs::read_to_string(&stdout).map_err(failed)?).map_err(|error| error.to_string())
        } else {
            Err(format!("{status}: {complaint}"))
        };
        Ok(DiagnosisRun { said, seconds })
    }

    fn wait(&self, mut child: Child) -> Result<ExitStatus, HuntError> {
        loop {
            if let Some(status) = child.try_wait().map_err(failed)? {
                // Ctrl-C reaches both; a diagnosis that it ended says nothing of the case.
                return if (self.interrupted)() { Err(HuntError::Interrupted) } else { Ok(status) };
            }
            if (self.interrupted)() {
                child.kill().and_then(|()| child.wait()).map_err(failed)?;
                return Err(HuntError::Interrupted);
            }
            std::thread::sleep(LOOK);
        }
    }
}
