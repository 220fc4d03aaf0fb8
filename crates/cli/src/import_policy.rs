//! `twinstep import-policy`: makes the mapping of a policy from the configs that its training left.

use std::path::PathBuf;

use crate::exit::{CommandResult, Failure, input};
use twinstep_agent::{ImportedPolicy, import_policy};

/// Make the mapping of a policy of another program from the files that its training left.
///
/// SOURCE is a file or a folder with: deploy.yaml of unitree_rl_lab or unitree_rl_mjlab, env.yaml and agent.yaml of Isaac Lab,
/// config.yaml of rl_sar, the config of legged_gym or HIMLoco (*.py), or a network with metadata of mjlab (*.onnx). With the
/// network among them, the sizes are compared too.
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
    let imported = import_policy(&args.source).map_err(input)?;
    match &args.out {
        Some(path) => {
            if path.exists() {
                return Err(Failure::Input(miette::miette!("`--out` = {} exists already", path.display())));
            }
            twinstep_files::write(path, &imported.mapping).map_err(input)?;
            eprintln!("{}", path.display());
        }
        None => print!("{}", imported.mapping),
    }
    eprint!("{}", report(&imported));
    if imported.missing.is_empty() {
        return Ok(());
    }
    let count = imported.missing.len();
    Err(Failure::Other(miette::miette!("the mapping lacks {count} entries: fill them in where it says `not found`")))
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
