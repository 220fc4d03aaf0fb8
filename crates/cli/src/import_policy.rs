//! `twinstep import-policy`: makes the mapping of a policy from the configs that its training left.

use std::path::PathBuf;

use twinstep_agent::{ImportedPolicy, import_policy};

use crate::exit::{CommandResult, Failure, input};
use twinstep_workflows::rehearsal::Rehearsal;

/// Make the mapping of a policy of another program from the files that its training left.
///
/// SOURCE is a file or a folder with: deploy.yaml of unitree_rl_lab or unitree_rl_mjlab, env.yaml and agent.yaml of Isaac Lab,
/// config.yaml of rl_sar, a config of unitree_rl_gym (*.yaml), that of legged_gym or HIMLoco (*.py), or a network with metadata
/// of mjlab (*.onnx). With the network among them, the sizes are compared too.
///
/// A complete mapping with its network is rehearsed: a simulated Go2 is commanded forward, then to turn. If no config contains
/// the order of the observation, that of the program is tried. If the robot does not walk with it, the others are tried, and the
/// best of them is written.
///
/// It says for every entry where its value comes from, what it assumed, where sources do not agree, and
/// what it could not find. The exit code is 1 if something is missing; the mapping then has a comment in its place.
///
/// Examples: `twinstep import-policy policy/velocity/v0 --out mapping.toml` and
/// `twinstep import-policy policy.onnx params/env.yaml params/agent.yaml --out mapping.toml`
#[derive(clap::Args)]
pub struct Args {
    /// Files, or folders in which they are looked for.
    #[arg(required = true)]
    source: Vec<PathBuf>,
    /// Mapping to write; it must not exist. Default: standard output.
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
}

/// Makes the mapping and says where its entries come from.
pub fn run(args: &Args) -> CommandResult {
    let existing = args.out.as_ref().filter(|path| path.exists());
    if let Some(path) = existing {
        return Err(Failure::Input(miette::miette!("`--out` = {} exists already", path.display())));
    }
    let mut imported = import_policy(&args.source).map_err(input)?;
    let rehearsed = rehearse(&mut imported);
    match &args.out {
        Some(path) => {
            twinstep_files::write(path, &imported.mapping).map_err(input)?;
            eprintln!("{}", path.display());
        }
        None => print!("{}", imported.mapping),
    }
    eprint!("{}{rehearsed}", report(&imported));
    if imported.missing.is_empty() {
        return Ok(());
    }
    let count = imported.missing.len();
    Err(Failure::Other(miette::miette!("the mapping lacks {count} entries: fill them in where it says `not found`")))
}

/// Rehearses a complete mapping, and other orders of its observation if no source contains the order. Returns what happened.
fn rehearse(imported: &mut ImportedPolicy) -> String {
    let Some(network) = imported.network.clone().filter(|_| imported.missing.is_empty()) else { return String::new() };
    let first = match Rehearsal::of(&network, &imported.mapping) {
        Ok(first) => first,
        Err(reason) => return format!("rehearsed     no: {reason}\n"),
    };
    if first.walks() {
        return format!("rehearsed     {first}\n");
    }
    if imported.alternatives.is_empty() {
        return format!(
            "rehearsed     {first}\n              it does not do what is commanded: compare the mapping with the program that trained it\n"
        );
    }
    let rehearsed = imported.alternatives.iter().filter_map(|alternative| {
        let rehearsal = Rehearsal::of(&network, &alternative.mapping).ok().filter(Rehearsal::walks)?;
        Some((alternative.clone(), rehearsal))
    });
    let mut walking: Vec<_> = rehearsed.collect();
    walking.sort_by(|(_, one), (_, other)| one.error().total_cmp(&other.error()));
    let count = imported.alternatives.len();
    let Some((best, rehearsal)) = walking.first() else {
        return format!(
            "rehearsed     {first}\n              with none of {count} other orders of the observation the robot walks\n"
        );
    };
    imported.mapping.clone_from(&best.mapping);
    let others = match walking.len() {
        1 => format!("the only one of {count} other orders with which the robot walks"),
        walking => format!("the best of {walking} with which the robot walks, of {count} other orders"),
    };
    format!("rehearsed     {first}\ntaken instead: {}, {others}: {rehearsal}\n", best.order)
}

fn report(imported: &ImportedPolicy) -> String {
    let origins = imported.origins.iter().map(|(key, place)| format!("{key:<13} {place}"));
    let network = imported.network.iter().map(|path| format!("{:<13} {}", "network", path.display()));
    let marked = |mark: &'static str, lines: &[String]| {
        lines.iter().map(move |line| format!("{mark} {line}")).collect::<Vec<_>>()
    };
    let lines = network
        .chain(origins)
        .chain(marked("assumed:", &imported.notes))
        .chain(marked("differs:", &imported.disagreements))
        .chain(marked("missing:", &imported.missing));
    lines.map(|line| line + "\n").collect()
}
