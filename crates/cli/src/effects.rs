//! `twinstep effects`: lists and explains the effects of the catalogue.

use std::path::{Path, PathBuf};

use twinstep_effects::{CATALOGUE, Effect};

use twinstep_identify::named;
use twinstep_report::{effect_page, effect_plot};

use crate::exit::{CommandResult, Failure, input};

/// List the effects in which real robots differ from the ideal model, or explain one of them.
///
/// Without NAME it prints the catalogue in the order of the chain from command to motion. With NAME it prints the
/// effect's law, its parameters with their prior ranges for a Go2, and its signature in a log. It also prints the
/// effects that it is often confused with, each with the experiment that discriminates between them.
///
/// Example: `twinstep effects coulomb_friction --plot friction.svg`
#[derive(clap::Args)]
pub struct Args {
    /// Name of the effect.
    name: Option<String>,
    /// Write a plot of the effect. It has a simulated motion without the effect and with a low, middle and high value
    /// of its prior range, the difference, and the law in quantities that a log contains.
    #[arg(long, value_name = "FILE.svg", requires = "name")]
    plot: Option<PathBuf>,
    /// Write a page with its plot for every effect, and a list of them: index.md. docs/effects is made so.
    #[arg(long, value_name = "DIR", conflicts_with = "name")]
    pages: Option<PathBuf>,
}

/// Prints the catalogue, or the page of one effect, or writes all pages.
pub fn run(args: &Args) -> CommandResult {
    if let Some(folder) = &args.pages {
        return write_pages(folder);
    }
    match &args.name {
        None => {
            for effect in CATALOGUE {
                println!("{:<20}  {:<18}  {}", effect.name, effect.chain_stage, effect.summary);
            }
            println!("\n`twinstep effects NAME` explains one effect.");
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

/// Writes the page and the plot of every effect, and the list of them.
fn write_pages(folder: &Path) -> CommandResult {
    std::fs::create_dir_all(folder).map_err(|cause| {
        Failure::Input(miette::miette!("`--pages` = {}: cannot create the folder: {cause}", folder.display()))
    })?;
    let write = |name: String, text: String| twinstep_files::write(folder.join(name), text).map_err(input);
    for effect in CATALOGUE {
        eprintln!("{}", effect.name);
        effect_plot::write_svg(effect, &folder.join(format!("{}.svg", effect.name))).map_err(input)?;
        write(format!("{}.md", effect.name), effect_page::page(effect))?;
    }
    write("index.md".to_owned(), effect_page::index())
}

/// Returns the page of an effect.
fn text(effect: &Effect) -> String {
    let mut lines = vec![format!("{}: {}", effect.name, effect.summary), String::new()];
    lines.push(format!("  law        {}", effect.equation));
    lines.push(format!("  acts at    {}", effect.chain_stage));
    lines.push(format!("  scopes     {}", effect.target.scopes()));
    lines.push(format!("  compose    {}", effect.composition.rule()));
    lines.push(format!("  signature  {}", effect.signature));
    lines.push("\nparameters".to_owned());
    for parameter in effect.parameters {
        let vector = if parameter.count > 1 { format!("[{}]", parameter.count) } else { String::new() };
        let [low, high] = parameter.prior_range;
        let [min, max] = parameter.bounds;
        lines.push(format!(
            "  {}{vector}  prior range {low} to {high} {}, allowed {min} to {max}; {} has no effect",
            parameter.name, parameter.unit, parameter.no_effect_value
        ));
        lines.push(format!("      source: {}", parameter.source));
    }
    if !effect.confounders.is_empty() {
        lines.push("\noften confused with".to_owned());
        for confounder in effect.confounders {
            lines.push(format!("  {:<20}  {}", confounder.effect, confounder.discriminating_experiment));
        }
    }
    lines.push(format!("\n`twinstep effects {} --plot FILE.svg` plots it.\n", effect.name));
    lines.join("\n")
}
