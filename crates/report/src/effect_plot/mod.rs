//! Plot of an effect: a motion without and with it, the difference, and its law in measured quantities.

mod quantity;

use std::path::Path;

use plotters::prelude::RGBColor;
use plotters::style::text_anchor::HPos;
use twinstep_effects::{DemoMotion, Effect, EffectDemo, EffectEntry, PlotQuantity, Scope, Target, apply_effects};
use twinstep_model::{
    BaseMount, Command, FIXED_BASE_HEIGHT, Ground, InitialState, Joint, Leg, PerJoint, Precision, RobotModel, Rollout,
    RolloutRequest, go2,
};
use twinstep_sim::{BatchRollout, SimConfig};

use crate::chart::{self, GREY, INK, Panel, PlotError};
use quantity::{SimulatedRun, value};

/// Width and height of the plot [px].
const SIZE: (u32, u32) = (1500, 1000);
/// Heights of the text above the panels and of the upper panel [half px].
const HEADER_HEIGHT: u32 = 270;
const UPPER_HEIGHT: u32 = 860;
/// Colours, from the smallest to the largest value of the effect.
const COLOURS: [RGBColor; 3] = [RGBColor(0xf2, 0xa7, 0x1b), RGBColor(0xe0, 0x40, 0x1f), RGBColor(0x7a, 0x1f, 0xa2)];
/// Voltage of a full battery, at which the motors have their full torque [V].
const FULL_V: f64 = 33.6;

/// Simulates the effect and writes the plot.
pub fn write_svg(effect: &'static Effect, path: &Path) -> Result<(), PlotError> {
    chart::check_writable(path)?;
    let mut robots = vec![("without".to_owned(), go2())];
    robots.extend(variants(effect)?);
    let runs = play(effect.demo.motion, robots.iter().map(|(_, robot)| robot))?;
    let names: Vec<_> = robots.into_iter().map(|(name, _)| name).collect();
    chart::write(&draw(effect, &names, &runs).map_err(simulate)?, path)
}

/// Returns robots with a low, middle and high value of the prior range, except a value that has no effect.
///
/// Only the first component of the first parameter varies, on the largest scope of the effect.
fn variants(effect: &'static Effect) -> Result<Vec<(String, RobotModel)>, PlotError> {
    let scope = match effect.target {
        Target::Joints | Target::Supply => Scope::All,
        Target::Bodies | Target::Imu => Scope::Base,
        Target::Ground => Scope::Ground,
    };
    let robot =
        |values| apply_effects(&go2(), &[EffectEntry::new(effect, scope, values).map_err(simulate)?]).map_err(simulate);
    if effect.replaces_body() {
        // Ten coordinates without a useful prior range each: a lighter and a heavier base of the same shape.
        let scaled = |factor: f64| {
            let values = go2().trunk.scaled(factor).log_cholesky().to_vec();
            Ok((format!("base mass × {factor}"), robot(values)?))
        };
        return [0.7, 1.4].map(scaled).into_iter().collect();
    }
    let (first, rest) = effect.parameters.split_first().expect("every effect has a parameter");
    let [low, high] = first.prior_range;
    let mut sizes = [low, f64::midpoint(low, high), high];
    if first.no_effect_value.is_infinite() {
        sizes.reverse();
    }
    let visible = sizes.into_iter().filter(|size| (size - first.no_effect_value).abs() > 1e-9);
    visible
        .map(|size| {
            let mut values = vec![size];
            values.resize(first.count, first.no_effect_value);
            values.extend(rest.iter().flat_map(|parameter| {
                std::iter::repeat_n(f64::midpoint(parameter.prior_range[0], parameter.prior_range[1]), parameter.count)
            }));
            let size = format!("{size:.4}").trim_end_matches('0').trim_end_matches('.').to_owned();
            Ok((format!("{} {size}", first.name), robot(values)?))
        })
        .collect()
}

/// Simulates the robots in a motion.
fn play<'a>(motion: &DemoMotion, robots: impl Iterator<Item = &'a RobotModel>) -> Result<Vec<SimulatedRun>, PlotError> {
    let config = SimConfig { threads: 1, ..SimConfig::default() };
    let mut simulator = BatchRollout::new(&go2(), &config).map_err(simulate)?;
    let runs = robots.map(|robot| {
        let (commands, supply, derating) = commands(motion, robot);
        let pose = commands[0].q;
        let start = match motion.base {
            BaseMount::Fixed => InitialState::at_rest(FIXED_BASE_HEIGHT as f32, pose),
            BaseMount::Floating => InitialState::standing_on(&Ground::FLAT, robot, pose, motion.clearance),
        };
        let states = simulator
            .run(
                &[RolloutRequest {
                    robot,
                    base: motion.base,
                    start,
                    history: &[],
                    commands: &commands,
                    derating: &derating,
                }],
                Precision::Double,
            )
            .remove(0);
        let joint = Joint { leg: Leg::FL, kind: motion.joint }.index();
        let settle = (motion.settle / robot.control.actuator_dt()).round() as usize;
        SimulatedRun { robot: robot.clone(), commands, supply, derating, joint, settle, states }
    });
    Ok(runs.collect())
}

/// Returns command, battery voltage [V] and motor temperature [°C], and derating factors of each actuator period.
fn commands(motion: &DemoMotion, robot: &RobotModel) -> (Vec<Command>, Vec<[f64; 2]>, Vec<PerJoint>) {
    let (dt, pose) = (robot.control.actuator_dt(), robot.control.default_pose);
    let period = |period: usize| {
        let t = (period as f64 * dt - motion.settle).max(0.0);
        let share = t / motion.duration;
        let [volts, celsius] = [motion.voltage, motion.temperature].map(|[from, to]| from + share * (to - from));
        let offset = (motion.target)(t);
        let q = std::array::from_fn(|joint| (pose[joint] + offset[Joint::ALL[joint].kind as usize]) as f32);
        let factor = |joint| robot.derating.derating_factor(joint, volts / FULL_V, celsius) as f32;
        (Command::hold(q, motion.kp, motion.kd), [volts, celsius], std::array::from_fn(factor))
    };
    (0..((motion.settle + motion.duration) / dt).round() as usize).map(period).collect()
}

fn draw(effect: &Effect, names: &[String], runs: &[SimulatedRun]) -> Result<String, PlotError> {
    chart::picture(SIZE, |root| {
        let (header, panels) = root.split_vertically(HEADER_HEIGHT);
        chart::text(&header, &format!("{}: {}", effect.name, effect.summary), 52, HPos::Center, (SIZE.0 as i32, 56))?;
        chart::text(&header, effect.equation, 36, HPos::Center, (SIZE.0 as i32, 124))?;
        let mut legend: Vec<_> = names.iter().map(String::as_str).zip([INK].into_iter().chain(COLOURS)).collect();
        if effect.demo.over_time == PlotQuantity::Position {
            legend.push(("command", GREY));
        }
        chart::legend(&header, &legend, 590, (60, 210))?;
        let (upper, lower) = panels.split_vertically(UPPER_HEIGHT);
        let (left, right) = lower.split_horizontally(SIZE.0);
        let EffectDemo { motion, over_time, law: [x, y] } = effect.demo;
        let mut upper_panel = panel(motion.what.to_owned(), PlotQuantity::Time, over_time, runs, &|run, period| {
            value(over_time, run, period)
        });
        if over_time == PlotQuantity::Position {
            let command =
                lines(&runs[..1], PlotQuantity::Time, &|run, period| f64::from(run.commands[period].q[run.joint]));
            upper_panel.lines.extend(command.into_iter().map(|line| chart::Line { colour: GREY, width: 2, ..line }));
            upper_panel.y = extent(&upper_panel.lines, |(_, y)| y);
        }
        upper_panel.draw(&upper)?;
        panel("difference due to the effect".to_owned(), PlotQuantity::Time, over_time, runs, &|run, period| {
            value(over_time, run, period) - value(over_time, &runs[0], period)
        })
        .draw(&left)?;
        panel("law in measured quantities".to_owned(), x, y, runs, &|run, period| value(y, run, period)).draw(&right)
    })
}

fn panel(
    caption: String,
    x: PlotQuantity,
    y: PlotQuantity,
    runs: &[SimulatedRun],
    of: &dyn Fn(&SimulatedRun, usize) -> f64,
) -> Panel {
    let lines = lines(runs, x, of);
    let (x_range, y_range) = (extent(&lines, |(x, _)| x), extent(&lines, |(_, y)| y));
    Panel { caption, x_label: x.label(), y_label: y.label(), x: x_range, y: y_range, lines }
}

fn lines(runs: &[SimulatedRun], x: PlotQuantity, of: &dyn Fn(&SimulatedRun, usize) -> f64) -> Vec<chart::Line> {
    let line = |(run, colour): (&SimulatedRun, RGBColor)| {
        let periods = run.settle..run.commands.len();
        let piece = periods.map(|period| (value(x, run, period), of(run, period))).collect();
        chart::Line { colour, width: 4, pieces: vec![piece] }
    };
    runs.iter().zip([INK].into_iter().chain(COLOURS)).map(line).collect()
}

fn extent(lines: &[chart::Line], of: fn((f64, f64)) -> f64) -> std::ops::Range<f64> {
    chart::range(lines.iter().flat_map(|line| line.pieces.iter().flatten()).map(|point| of(*point)))
}

fn simulate(error: impl std::error::Error) -> PlotError {
    PlotError::Simulate(error.to_string())
}
