//! `twinstep effects`: what the catalogue knows.

use std::path::PathBuf;

use twinstep_effects::{CATALOGUE, Composition, Effect, Target};

use twinstep_identify::named;
use twinstep_report::effect_plot;

use crate::exit::{CommandResult, input};

/// Explain what real robots do and ideal ones do not.
///
/// Without a name: the catalogue, in the order in which effects act from command to motion. With a name: the effect's law,
/// its parameters with what is plausible for a Go2, what it looks like in a log, what it is taken for, and the experiment
/// that tells them apart.
///
/// Example: `twinstep effects coulomb_friction --plot friction.svg`
#[derive(clap::Args)]
pub struct Args {
    /// The effect.
    name: Option<String>,
    /// Write a picture of the effect: a simulated motion without it and with its low, middle and high plausible size,
    /// the difference, and its law in what a log shows.
    #[arg(long, value_name = "FILE.svg", requires = "name")]
    plot: Option<PathBuf>,
}

/// Prints.
pub fn run(args: &Args) -> CommandResult {
    match &args.name {
        None => {
            for effect in CATALOGUE {
                println!("{:<20}  {:<18}  {}", effect.name, effect.chain_stage, effect.summary);
            }
            println!("\n`twinstep effects NAME` explains one.");
        }
        Some(name) => {
            let effect = named(name).map_err(input)?;
            if let Some(path) = &args.plot {
                effect_plot::write_svg(effect, path).map_err(input)?;
            }
            print!("{}", text(effect));
        }
    }
    Ok(())
}

/// The page of an effect.
fn text(effect: &Effect) -> String {
    let mut lines = vec![format!("{}: {}", effect.name, effect.summary), String::new()];
    lines.push(format!("  law        {}", effect.equation));
    lines.push(format!("  acts at    {}", effect.chain_stage));
    let scopes = match effect.target {
        Target::Joints => "all, hip, thigh, calf, FL, FR, RL, RR, left, right, or a joint such as FL_hip",
        Target::Supply => "all",
        Target::Bodies => "base, or a joint for its child link",
        Target::Base => "base",
        Target::Ground => "ground",
    };
    lines.push(format!("  scopes     {scopes}"));
    let composition = match effect.composition {
        Composition::Add => "entries that overlap add up",
        Composition::Multiply => "entries that overlap multiply",
        Composition::Replace => "the entry with the narrowest scope counts, of equal ones the last",
    };
    lines.push(format!("  compose    {composition}"));
    lines.push(format!("  in data    {}", effect.signature));
    lines.push("\nparameters".to_owned());
    for parameter in effect.parameters {
        let vector = if parameter.count > 1 { format!("[{}]", parameter.count) } else { String::new() };
        let [low, high] = parameter.prior_range;
        let [least, most] = parameter.bounds;
        lines.push(format!(
            "  {}{vector}  plausible {low} to {high} {}, allowed {least} to {most}; {} changes nothing",
            parameter.name, parameter.unit, parameter.no_effect_value
        ));
        lines.push(format!("      source: {}", parameter.source));
    }
    if !effect.confounders.is_empty() {
        lines.push("\ntaken for".to_owned());
        for confusion in effect.confounders {
            lines.push(format!("  {:<20}  {}", confusion.effect, confusion.discriminating_experiment));
        }
    }
    lines.push(format!("\n`twinstep effects {} --plot FILE.svg` draws it.\n", effect.name));
    lines.join("\n")
}
