//! `twinstep evaluate-policy`: velocity errors, falls and gait of a policy, on engines and robots that it has not seen.

use std::path::PathBuf;

use twinstep_measures::{CONDITION_NAMES, CourseWalking};
use twinstep_sim::{CourseTerrain, Engine};
use twinstep_workflows::{Course, EvaluatePolicyOptions, Observer, evaluate_policy};

use crate::exit::CommandResult;
use crate::ground_arg::{self, GroundArg};
use crate::serve::engine;

/// Evaluate a policy: velocity errors, falls and gait, on engines and robots that it has not seen.
///
/// The mean action of the policy steps fresh robots with the default commands of `walk`: a new one
/// every 5 s. A policy of `track` follows a circle, a figure of eight and a square, with and
/// without motion capture. A policy of `gait` is commanded a trot, a pace, a bound and a pronk,
/// under nominal, robots, pushes and delay. A policy of `attitude` follows sines of roll, pitch and
/// height. A policy of `getup` gets up from any orientation. A policy of `jump` jumps once to both
/// ends and the middle of the ranges of its targets, or to its only target. A robot that has fallen
/// no longer counts for the errors, but its landing before the fall does. Conditions:
///
///   nominal   the robot of the model file on flat ground
///   robots    masses +-15 %, friction 0.4 to 1.25, gains +-10 %
///   ground    random heights of up to 3 cm
///   steps     level treads of 30 cm with steps of 3 cm between them
///   pushes    0.5 m/s in a random direction, every 5 to 10 s
///   delay     commands arrive 0 to 20 ms late
///   noise     errors of the sensors as in Isaac Lab
///   robust    robots, steps, pushes and delay at once
///
/// --course shows how steep and high a ground a policy of `walk` masters instead: slopes, stairs,
/// obstacles, waves and rough ground at ten levels each. Every robot starts in the middle of a
/// patch of 8 m and walks on at 0.8 m/s, while it turns to a random heading; the table has the share
/// that arrive at its border within 20 s. --ground has one level: `--ground stairs=0.15`. With
/// --condition these are the robots, delays and pushes of that condition. Gains and action scale are
/// those of the policy, without --model.
///
/// Without --engine the nominal robot is also simulated in rapier, which no policy is trained in.
/// `--engine mujoco` needs `pip install "twinstep[mujoco]"` and simulates a thousand env-steps per
/// second.
///
/// Examples: `twinstep evaluate-policy walk/policy.safetensors` and `twinstep evaluate-policy
/// walk/policy.safetensors --engine mujoco --robots 64`
#[derive(clap::Args)]
#[command(verbatim_doc_comment, group(clap::ArgGroup::new("on_course").args(["course", "ground"]).multiple(true)))]
pub struct Args {
    /// Policy file (safetensors).
    policy: PathBuf,
    /// Model file of the robot. Default: the ideal Go2.
    #[arg(long, value_name = "FILE")]
    model: Option<PathBuf>,
    /// Physics engine of all conditions. Default: batch, and rapier for the nominal robot.
    #[arg(long, value_parser = engine)]
    engine: Option<Engine>,
    /// Evaluate under these conditions only; repeat it for several. Default: all.
    #[arg(long, value_name = "NAME", value_parser = CONDITION_NAMES)]
    condition: Vec<String>,
    /// Number of robots.
    #[arg(long, value_name = "N", default_value_t = 256, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    robots: u32,
    /// Simulated time of each robot [s]. A jump takes 3 s, getting up 5 s.
    #[arg(long, value_name = "S", default_value_t = 20.0)]
    seconds: f64,
    /// Seed of robots and commands.
    #[arg(long, default_value_t = 1_000_000)]
    seed: u64,
    /// Write a film strip (SVG) of a robot with the first condition, 0.08 s between two frames.
    #[arg(long, value_name = "FILE")]
    film: Option<PathBuf>,
    /// Walk over slopes, stairs, obstacles, waves and rough ground instead.
    #[arg(long, conflicts_with_all = ["seconds", "film"])]
    course: bool,
    /// Walk over this ground instead: slope [rad], stairs, obstacles, wave or rough [m]; repeat it for several.
    #[arg(long, value_name = "KIND=SIZE", value_parser = ground_arg::ground, conflicts_with_all = ["course", "seconds", "film"])]
    ground: Vec<GroundArg>,
    /// Commanded velocity forward on a course or a ground [m/s]. Default: 0.8.
    #[arg(long, value_name = "M_S", requires = "on_course")]
    speed: Option<f32>,
    /// Print one JSON object on stdout.
    #[arg(long)]
    json: bool,
}

/// Evaluates the policy under each condition.
pub fn run(args: &Args) -> CommandResult {
    let options = args.options();
    let found = evaluate_policy(&options, &Observer::terminal()?)?;
    if args.json {
        println!("{}", serde_json::json!({ "policy": args.policy, "rows": found }));
    } else {
        print!("{}", found.table(&options));
    }
    Ok(())
}

impl Args {
    /// Returns the course that is asked for.
    fn course(&self) -> Option<Course> {
        let terrain = if self.course { Some(CourseTerrain::FULL) } else { ground_arg::course(&self.ground) };
        terrain.map(|terrain| Course { terrain, speed: self.speed.unwrap_or(CourseWalking::SPEED) })
    }

    fn options(&self) -> EvaluatePolicyOptions {
        EvaluatePolicyOptions {
            model: self.model.clone(),
            engine: self.engine,
            conditions: self.condition.clone(),
            course: self.course(),
            robots: self.robots,
            seconds: self.seconds,
            seed: self.seed,
            film: self.film.clone(),
            ..EvaluatePolicyOptions::new(&self.policy)
        }
    }
}
