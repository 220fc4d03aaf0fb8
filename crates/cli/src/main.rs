//! Command line `twinstep`, with one file per subcommand.

mod adapt;
mod bench;
mod demo;
mod diagnose;
mod effects;
mod evaluate;
mod evaluate_policy;
mod excite;
mod exit;
mod fake_process;
mod fake_robot;
mod fit;
mod frame_feed;
mod ground_arg;
mod help;
mod hunt;
mod identify;
mod import_policy;
mod key_terminal;
mod line_printer;
mod list;
mod log;
mod log_writer;
mod mjcf;
mod onboard_policy;
mod operator;
mod operator_screen;
mod play;
mod preflight;
mod robot;
mod robot_env_factory;
mod robot_view;
mod run;
mod run_view;
mod serve;
mod spi_active;
mod stop_signals;
mod train;
mod u2e;
mod velocity_input;
mod view;
mod view_endpoint;
mod view_log;
mod view_policy;
mod view_tree;
mod watchdog;
mod web_view;
mod write_only_backend;

use clap::{CommandFactory, FromArgMatches, Parser, Subcommand};
use twinstep_simd::InstructionSet;

/// Simulate thousands of Unitree Go2 robots for reinforcement learning, and measure the gap to the real robot.
#[derive(Parser)]
#[command(version, propagate_version = true)]
struct Cli {
    #[command(subcommand)]
    command: CliCommand,
}

#[derive(Subcommand)]
enum CliCommand {
    Adapt(adapt::Args),
    Bench(bench::Args),
    Demo(demo::Args),
    Diagnose(diagnose::Args),
    Effects(effects::Args),
    Evaluate(evaluate::Args),
    EvaluatePolicy(evaluate_policy::Args),
    FakeRobot(fake_robot::Args),
    Fit(fit::Args),
    Excite(excite::Args),
    Hunt(hunt::Args),
    Identify(identify::Args),
    ImportPolicy(import_policy::Args),
    List(list::Args),
    Log(log::Args),
    Mjcf(mjcf::Args),
    Play(play::Args),
    Preflight(preflight::Args),
    Robot(robot::Args),
    Run(run::Args),
    Serve(serve::Args),
    SpiActive(spi_active::Args),
    Train(train::Args),
    #[command(name = "u2e")]
    U2e(u2e::Args),
    View(view::Args),
    #[command(hide = true)]
    Watchdog(watchdog::Args),
}

fn main() -> std::process::ExitCode {
    let matches = help::grouped(Cli::command()).get_matches();
    let command = Cli::from_arg_matches(&matches).unwrap_or_else(|error| error.exit()).command;
    if let CliCommand::Watchdog(args) = &command {
        return exit::code(watchdog::run(args));
    }
    let log = match &command {
        // Their errors have the reason; Zenoh would write two lines for each attempt to connect.
        CliCommand::Adapt(_)
        | CliCommand::List(_)
        | CliCommand::Run(_)
        | CliCommand::SpiActive(_)
        | CliCommand::U2e(_) => "warn,zenoh=off",
        _ => "warn,zenoh::api::session=error,rustdds=off,twinstep=info",
    };
    tracing_subscriber::fmt()
        .with_env_filter(tracing_subscriber::EnvFilter::try_from_env("TWINSTEP_LOG").unwrap_or_else(|_| log.into()))
        .with_writer(|| log_writer::LogWriter)
        .init();
    let result = InstructionSet::from_environment().map_err(exit::input).and_then(|_| match command {
        CliCommand::Adapt(args) => adapt::run(&args),
        CliCommand::Bench(args) => bench::run(&args),
        CliCommand::Demo(args) => demo::run(&args),
        CliCommand::Diagnose(args) => diagnose::run(&args),
        CliCommand::Effects(args) => effects::run(&args),
        CliCommand::Evaluate(args) => evaluate::run(&args),
        CliCommand::EvaluatePolicy(args) => evaluate_policy::run(&args),
        CliCommand::FakeRobot(args) => fake_robot::run(&args),
        CliCommand::Fit(args) => fit::run(&args),
        CliCommand::Excite(args) => excite::run(&args),
        CliCommand::Hunt(args) => hunt::run(&args),
        CliCommand::Identify(args) => identify::run(&args),
        CliCommand::ImportPolicy(args) => import_policy::run(&args),
        CliCommand::List(args) => list::run(&args),
        CliCommand::Log(args) => log::run(&args),
        CliCommand::Mjcf(args) => mjcf::run(&args),
        CliCommand::Play(args) => play::run(&args),
        CliCommand::Preflight(args) => preflight::run(&args),
        CliCommand::Robot(args) => robot::run(&args),
        CliCommand::Run(args) => run::run(&args),
        CliCommand::Serve(args) => serve::run(&args),
        CliCommand::SpiActive(args) => spi_active::run(&args),
        CliCommand::Train(args) => train::run(&args),
        CliCommand::U2e(args) => u2e::run(&args),
        CliCommand::View(args) => view::run(&args),
        CliCommand::Watchdog(args) => watchdog::run(&args),
    });
    exit::code(result)
}
