//! Fine-tuning of policies on models of hidden robots, and their evaluation on these robots in MuJoCo.

use std::path::{Path, PathBuf};

use serde_json::Value;

use crate::mujoco_ground_truth::MujocoGroundTruth;
use crate::resumable::{Step, read, text};

/// A task and its errors.
pub struct Task {
    /// Name in tables and files.
    pub name: &'static str,
    /// The task in a config file.
    task: &'static str,
    /// Settings of its fine-tuning.
    settings: &'static str,
    /// Names of the errors in the table, with JSON pointers to them in the evaluation.
    pub errors: &'static [(&'static str, &'static str)],
    /// JSON pointer to the share of the robots that did not fall.
    pub up: &'static str,
    /// Duration of the evaluation [s].
    seconds: u32,
}

impl Task {
    /// Returns true if the policy from which the methods start is evaluated on the same targets.
    pub fn has_start(&self) -> bool {
        self.settings.is_empty()
    }
}

/// The tasks.
pub const TASKS: [Task; 5] = [
    Task {
        name: "walk",
        task: "walk",
        settings: "",
        errors: &[("velocity RMS [m/s]", "/rows/0/velocity_rms")],
        up: "/rows/0/up",
        seconds: 20,
    },
    Task {
        name: "jump",
        task: "jump",
        settings: "target_x_m = [0.85, 0.85]\n",
        errors: &[("landing error of a jump of 0.85 m [m]", "/rows/0/targets/0/l_jump")],
        up: "/rows/0/targets/0/up",
        seconds: 3,
    },
    Task {
        name: "turn",
        task: "jump",
        settings: "target_x_m = [0.0, 0.0]\ntarget_yaw_rad = [2.356, 2.356]\nreward.symmetry = 0.0\n\
                   walk.reward.hip_deviation = 0.0\n",
        errors: &[
            ("yaw error of the landing of a jump with a turn of 135° [rad]", "/rows/0/targets/0/yaw_error"),
            ("distance of this landing from the start [m]", "/rows/0/targets/0/distance"),
        ],
        up: "/rows/0/targets/0/up",
        seconds: 3,
    },
    Task {
        name: "track",
        task: "track",
        settings: "",
        errors: &[("L_track, circle [m + rad]", "/rows/0/paths/0/l_track")],
        up: "/rows/0/paths/0/up",
        seconds: 20,
    },
    Task {
        name: "attitude",
        task: "attitude",
        settings: "",
        errors: &[("L_attitude [rad]", "/rows/0/l_attitude")],
        up: "/rows/0/up",
        seconds: 20,
    },
];

/// Fine-tuning for a hidden robot. The results are in the folder of the robot.
pub struct FineTuning<'a> {
    /// The robot.
    pub robot: &'a MujocoGroundTruth,
    /// Environment steps of a fine-tuning.
    pub steps: u64,
    /// Simulated robots of an evaluation.
    pub evaluated: u32,
    /// Seed of the trainings.
    pub seed: u64,
}

impl FineTuning<'_> {
    /// Continues the training in the folder `start` on a model; `None`: the ideal Go2. Returns the policy.
    ///
    /// A policy that is there is kept. `name` is that of its folder, and `settings` are further tables of the config file.
    pub fn train(&self, task: &Task, name: &str, model: Option<&Path>, settings: &str, start: &Path) -> Step<PathBuf> {
        let commands = &self.robot.commands;
        let (out, config) = (commands.path(name), commands.path(&format!("{name}.toml")));
        let task_table = format!("[task]\nname = \"{}\"\n{}{settings}", task.task, task.settings);
        std::fs::write(&config, task_table).map_err(text)?;
        let [from, config] = [start.join("checkpoint.safetensors"), config].map(|path| path.display().to_string());
        let (steps, seed) = (self.steps.to_string(), self.seed.to_string());
        let mut arguments =
            vec!["train", task.task, "--config", &config, "--from", &from, "--steps", &steps, "--seed", &seed];
        let model = model.map(|path| path.display().to_string());
        arguments.extend(model.iter().flat_map(|model| ["--model", model.as_str()]));
        commands.step(&out.join("evaluation.json"), &arguments, &out)?;
        Ok(out.join("policy.safetensors"))
    }

    /// Evaluates a policy on the robot in MuJoCo, unless the file `name` with the result exists. Returns the result.
    pub fn evaluate(&self, task: &Task, name: &str, policy: &Path) -> Step<Value> {
        let commands = &self.robot.commands;
        let result = commands.path(&format!("{name}.json"));
        if !result.exists() {
            let [model, policy] = [&self.robot.model, policy].map(|path| path.display().to_string());
            let (robots, seconds) = (self.evaluated.to_string(), task.seconds.to_string());
            let json =
                commands.run(
                    &[
                        &[
                            "evaluate-policy",
                            &policy,
                            "--engine",
                            "mujoco",
                            "--model",
                            &model,
                            "--condition",
                            "nominal",
                        ][..],
                        &["--robots", &robots, "--seconds", &seconds, "--json"],
                    ]
                    .concat(),
                )?;
            std::fs::write(&result, json).map_err(text)?;
        }
        read(&result)
    }
}
