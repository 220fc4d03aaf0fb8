//! Command line `twinstep`, with one file per subcommand.

mod ambiguous_effects;
mod bench;
mod command_env;
mod cross_evaluation;
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
mod help;
mod hunt;
mod identify;
mod identify_tree;
mod import_policy;
mod key_terminal;
mod learned_residual;
mod line_printer;
mod list;
mod log;
mod log_writer;
mod measure_tables;
mod mjcf;
mod onboard_policy;
mod open_log;
mod operator;
mod operator_screen;
mod play;
mod player;
mod preflight;
mod random_commands;
mod rehearsal;
mod robot;
mod robot_env_factory;
mod robot_file;
mod robot_view;
mod run;
mod run_view;
mod serve;
mod spi_active;
mod spi_active_config;
mod spi_active_report;
mod stages;
mod status_line;
mod stop_signals;
mod train;
mod train_config;
mod train_endpoints;
mod train_evaluation;
mod train_log;
mod tree_model;
mod u2e;
mod u2e_config;
mod u2e_evaluation;
mod u2e_report;
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
        CliCommand::List(_) | CliCommand::Run(_) | CliCommand::SpiActive(_) | CliCommand::U2e(_) => "warn,zenoh=off",
        _ => "warn,zenoh::api::session=error,rustdds=off,twinstep=info",
    };
    tracing_subscriber::fmt()
        .with_env_filter(tracing_subscriber::EnvFilter::try_from_env("TWINSTEP_LOG").unwrap_or_else(|_| log.into()))
        .with_writer(|| log_writer::LogWriter)
        .init();
    let result = InstructionSet::from_environment().map_err(exit::input).and_then(|_| match command {
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
