//! The findings: the law of each in the data, its size, and the rivals that it beat.

use twinstep_diagnose::{AlternativeCause, Cause, Diagnosis, Estimate, ParameterValue};
use twinstep_effects::{Effect, Parameter};

use crate::html::{alike, bar, escape, number, percent};
use crate::overview::key;
use crate::report_data::ReportData;
use crate::{plot, text};

/// One card a finding.
pub fn cards(diagnosis: &Diagnosis, evidence: &ReportData) -> String {
    if diagnosis.findings.is_empty() {
        return String::new();
    }
    let cards: String =
        diagnosis.findings.iter().enumerate().map(|(index, finding)| card(index + 1, finding, evidence)).collect();
    format!(
        "<section>\n<h2>What causes it</h2>\n{cards}<p class=\"note\">Dots: what the extended model leaves without \
         this one finding, so that the others do not blur it. Line: what the finding takes away of that. Unexplained \
         torque is what the model's motors, friction and springs give, less what its bodies need for the measured \
         motion.</p>\n</section>\n"
    )
}

fn card(rank: usize, finding: &Cause, evidence: &ReportData) -> String {
    let name = text::sentence(&text::cause(&finding.effect, &finding.scope));
    let effect = Effect::named(&finding.effect);
    format!(
        "<article>\n<h3>{rank}. {name} <span class=\"gain-badge\">removes {}</span></h3>\n\
         <div class=\"pair\">\n<div>\n<p class=\"evidence\">{}</p>\n{}{}</div>\n{}</div>\n</article>\n",
        percent(finding.held_out_gain),
        escape(&finding.evidence),
        effect.map_or(String::new(), catalogue),
        parameters(finding, effect),
        law(finding, evidence)
    )
}

/// What the catalogue says of an effect.
fn catalogue(effect: &Effect) -> String {
    let [what, equation, signature] = [effect.summary, effect.equation, effect.signature].map(escape);
    format!(
        "<dl>\n<dt>Effect</dt><dd>{what}</dd>\n<dt>Law</dt><dd><code>{equation}</code></dd>\n\
         <dt>In data</dt><dd>{signature}</dd>\n</dl>\n"
    )
}

fn law(finding: &Cause, evidence: &ReportData) -> String {
    let cause = (finding.effect.clone(), finding.scope.clone());
    let Some(law) = evidence.laws.iter().find(|law| law.cause == cause) else {
        return "<p class=\"note\">The log in the pictures does not show this effect on its own.</p>\n".to_owned();
    };
    let keys = key("mean", "without it: mean, middle 68 %") + &key("law", "what it explains");
    let picture = plot::law(&law.bins, law.x_label, law.y_label);
    format!("<figure><figcaption><strong>Its law in this log</strong>{keys}</figcaption>{picture}</figure>\n")
}

/// Values with their intervals, before what is plausible.
fn parameters(finding: &Cause, effect: Option<&'static Effect>) -> String {
    let mut items = String::new();
    for (name, estimate) in &finding.parameters {
        let known = effect.and_then(|effect| effect.parameters.iter().find(|parameter| parameter.name == name));
        for (index, numbers) in components(estimate).into_iter().enumerate() {
            let vector = matches!(estimate.value, ParameterValue::Vector(_));
            let label = if vector { format!("{}[{index}]", escape(name)) } else { escape(name) };
            items += &parameter(&label, numbers, known);
        }
    }
    items
}

fn parameter(label: &str, numbers: [f64; 3], known: Option<&Parameter>) -> String {
    let [value, low, high] = numbers;
    let unit = known.map_or("", |known| known.unit);
    let plausible = known.map_or([value, value], |known| known.prior_range);
    let picture = plot::whisker(value, [low, high], plausible);
    let [value, low, high] = alike(numbers);
    let size = format!("{value} {unit}");
    let [from, to] = plausible.map(|end| format!("{end}").replace('-', "−"));
    let range = known.map_or(String::new(), |_| format!("plausible for a Go2: {from} to {to} {unit}"));
    format!(
        "<div class=\"parameter\"><code>{label}</code> <strong>{}</strong>, 95 %: {low} to {high}\n{picture}\
         <span class=\"small\">{}</span></div>\n",
        size.trim_end(),
        range.trim_end()
    )
}

/// Value, low and high of each number.
fn components(estimate: &Estimate) -> Vec<[f64; 3]> {
    let of = |value: &ParameterValue, index: usize| match value {
        ParameterValue::Number(number) => *number,
        ParameterValue::Vector(numbers) => numbers.get(index).copied().unwrap_or(f64::NAN),
    };
    let count = if let ParameterValue::Vector(numbers) = &estimate.value { numbers.len() } else { 1 };
    (0..count).map(|index| [&estimate.value, &estimate.low, &estimate.high].map(|end| of(end, index))).collect()
}

/// Findings and rivals, with what each would have gained.
pub fn ranking(diagnosis: &Diagnosis) -> String {
    if diagnosis.findings.is_empty() {
        return String::new();
    }
    let mut rows = String::new();
    for (index, finding) in diagnosis.findings.iter().enumerate() {
        rows += &finding_row(index + 1, finding);
        rows.extend(finding.rivals.iter().map(|rival| alternative_row(rival, finding.held_out_gain)));
    }
    format!(
        "<section>\n<h2>What else it could have been</h2>\n<div class=\"wide\"><table class=\"ranking\">\n\
         <thead><tr><th>hypothesis</th><th>gain on held-out data</th><th></th><th>evidence</th></tr></thead>\n\
         <tbody>\n{rows}</tbody></table></div>\n\
         <p class=\"note\">Gain: the share of the error, where the effect acts, that goes away on data that was held \
         out. Each finding is added to those above it, and its rivals stand in its place. Evidence has to be more \
         than a threshold that is the same for every log.</p>\n</section>\n"
    )
}

fn finding_row(rank: usize, finding: &Cause) -> String {
    format!(
        "<tr class=\"winner\"><th scope=\"row\">{rank}. {}</th><td>{}</td><td>{}</td><td>{} \
         <span class=\"small\">nats, needs {}</span></td></tr>\n",
        text::sentence(&text::cause(&finding.effect, &finding.scope)),
        bar(finding.held_out_gain, "gain"),
        percent(finding.held_out_gain),
        number(finding.score_nats),
        number(finding.threshold_nats)
    )
}

fn alternative_row(rival: &AlternativeCause, gain: f64) -> String {
    let lost = 100.0 * (gain - rival.held_out_gain);
    let verdict = if lost >= 0.5 { format!("{lost:.0} points less") } else { "as good".to_owned() };
    format!(
        "<tr class=\"rival\"><th scope=\"row\">{}</th><td>{}</td><td>{}</td><td class=\"small\">{verdict}</td></tr>\n",
        text::cause(&rival.effect, &rival.scope),
        bar(rival.held_out_gain, "lost"),
        percent(rival.held_out_gain)
    )
}
