//! Pages of the effects of the catalogue, as Markdown: what each is, what it looks like, and what it is confused with.

use twinstep_effects::{CATALOGUE, DataRequirement, Effect, Parameter};

/// Returns the page of an effect, beside which its plot is `NAME.svg`.
pub fn page(effect: &Effect) -> String {
    let name = effect.name;
    let mut lines = vec![
        format!("# {name}"),
        String::new(),
        effect.summary.to_owned(),
        String::new(),
        format!("![Motion without and with {name}, the difference, and the law]({name}.svg)"),
        String::new(),
        "## Law".to_owned(),
        String::new(),
        format!("`{}`", effect.equation),
        String::new(),
        format!("Stage in the chain from command to motion: {}.", effect.chain_stage),
        format!("In a log: {}", effect.signature),
        String::new(),
        "| parameter | unit | prior range (95 %) | allowed | no effect | source of the prior |".to_owned(),
        "|---|---|---|---|---|---|".to_owned(),
    ];
    lines.extend(effect.parameters.iter().map(parameter_row));
    lines.extend([String::new(), "## In a model file".to_owned(), String::new()]);
    lines.push(format!("Scopes: {}.", effect.target.scopes()));
    lines.push(format!("If entries overlap, {}.", effect.composition.rule()));
    if !effect.replaces_body() {
        lines.extend(["", "```toml", &entry(effect), "```"].map(str::to_owned));
    }
    lines.extend(["", "## In measured data", ""].map(str::to_owned));
    lines.push(requirements("A log shows it only with", effect.needs));
    if !effect.recommended.is_empty() {
        lines.push(requirements("It is better with", effect.recommended));
    }
    if !effect.caveat.is_empty() {
        lines.push(format!("Note: {}.", effect.caveat));
    }
    lines.push(format!("What to do about it: {}", effect.remedy));
    if !effect.confounders.is_empty() {
        lines.extend([String::new(), "## Often confused with".to_owned(), String::new()]);
        lines.extend(["| effect | the experiment that tells them apart |".to_owned(), "|---|---|".to_owned()]);
        let row = |other: &twinstep_effects::Confounder| {
            format!("| [{0}]({0}.md) | {1} |", other.effect, other.discriminating_experiment)
        };
        lines.extend(effect.confounders.iter().map(row));
    }
    lines.extend([String::new(), "[All effects](index.md)".to_owned(), String::new()]);
    lines.join("\n")
}

/// Returns the list of all effects.
pub fn index() -> String {
    let mut lines = vec![
        "# Effects".to_owned(),
        String::new(),
        "A real robot differs from the ideal one in these effects. They are in the order of the chain from command to motion."
            .to_owned(),
        "Each page has the law, a picture, and the effects with which it is confused. `twinstep effects --pages DIR` writes them."
            .to_owned(),
        String::new(),
        "| effect | stage | what it is |".to_owned(),
        "|---|---|---|".to_owned(),
    ];
    let row =
        |effect: &Effect| format!("| [{0}]({0}.md) | {1} | {2} |", effect.name, effect.chain_stage, effect.summary);
    lines.extend(CATALOGUE.into_iter().map(row));
    lines.push(String::new());
    lines.join("\n")
}

/// Returns an entry with the middle of each prior range.
fn entry(effect: &Effect) -> String {
    let scope = effect.target.scopes().split(',').next().unwrap_or("all");
    let values = effect.parameters.iter().map(|parameter| format!("\n{} = {}", parameter.name, example(parameter)));
    format!("[[effect]]\nname = \"{}\"\nscope = \"{scope}\"{}", effect.name, values.collect::<String>())
}

fn parameter_row(parameter: &Parameter) -> String {
    let Parameter { name, unit, count, bounds: [min, max], prior_range: [low, high], no_effect_value, source } =
        parameter;
    let vector = if *count > 1 { format!(" [{count}]") } else { String::new() };
    let unit = if unit.is_empty() { "1" } else { unit };
    format!("| `{name}`{vector} | {unit} | {low} to {high} | {min} to {max} | {no_effect_value} | {source} |")
}

/// Returns the middle of the prior range, as TOML.
fn example(parameter: &Parameter) -> String {
    let [low, high] = parameter.prior_range;
    let middle = format!("{:?}", (500.0 * (low + high)).round() / 1000.0);
    if parameter.count == 1 { middle } else { format!("[{}]", vec![middle; parameter.count].join(", ")) }
}

fn requirements(intro: &str, all: &[DataRequirement]) -> String {
    if all.is_empty() {
        return "Every log shows it.".to_owned();
    }
    let words: Vec<String> = all.iter().map(ToString::to_string).collect();
    format!("{intro}: {}.", words.join("; "))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn confounders_of_every_page_have_pages() {
        for effect in CATALOGUE {
            for other in effect.confounders {
                assert!(Effect::named(other.effect).is_some(), "{} names {}", effect.name, other.effect);
                assert!(page(effect).contains(&format!("({}.md)", other.effect)));
            }
        }
    }

    #[test]
    fn entries_of_the_pages_are_entries_of_a_model_file() {
        for effect in CATALOGUE.into_iter().filter(|effect| !effect.replaces_body()) {
            let page = page(effect);
            let entry = page.split("```toml\n").nth(1).and_then(|rest| rest.split("```").next()).expect("an example");
            let file = twinstep_effects::ModelFile::parse(&format!("robot = \"go2\"\n{entry}"), "page");
            assert!(file.is_ok(), "{}: {:?}\n{entry}", effect.name, file.err());
        }
    }
}
