//! Causes in the report: law in the data, estimates, and alternative hypotheses.

use twinstep_diagnose::{AlternativeCause, Cause, Diagnosis, Estimate, ParameterValue};
use twinstep_effects::{Effect, Parameter};

use crate::html::{alike, bar, escape, number, percent};
use crate::overview::key;
use crate::report_data::ReportData;
use crate::{plot, text};

/// Returns one card per cause.
pub fn cards(diagnosis: &Diagnosis, data: &ReportData) -> String {
    if diagnosis.findings.is_empty() {
        return String::new();
    }
    let cards: String =
        diagnosis.findings.iter().enumerate().map(|(index, finding)| card(index + 1, finding, data)).collect();
    format!(
        "<section>\n<h2>Identified causes</h2>\n{cards}<p class=\"note\">Dots: residual of the extended model without \
         this one cause, so that the other causes do not blur it. Line: the part of it that the cause explains. The \
         inverse-dynamics residual is the torque of the model's motors, friction and springs, minus the torque that \
         its bodies need for the measured motion.</p>\n</section>\n"
    )
}

fn card(rank: usize, finding: &Cause, data: &ReportData) -> String {
    let name = text::sentence(&text::cause(&finding.effect, &finding.scope));
    let effect = Effect::named(&finding.effect);
    format!(
        "<article>\n<h3>{rank}. {name} <span class=\"gain-badge\">error reduced by {}</span></h3>\n\
         <div class=\"pair\">\n<div>\n<p class=\"evidence\">{}</p>\n{}{}{}</div>\n{}</div>\n</article>\n",
        percent(finding.held_out_gain),
        escape(&finding.evidence),
        remedy(finding),
        effect.map_or(String::new(), catalogue),
        parameters(finding, effect),
        law(finding, data)
    )
}

/// Returns what to do about a cause, with the gain that it promises.
fn remedy(finding: &Cause) -> String {
    if finding.remedy.is_empty() {
        return String::new();
    }
    let gain = percent(finding.held_out_gain);
    format!(
        "<p><strong>What to do.</strong> {} It removes about {gain} of the error in the affected channels.</p>\n",
        text::with_code(&finding.remedy)
    )
}

/// Returns the catalogue's description of an effect.
fn catalogue(effect: &Effect) -> String {
    let [what, equation, signature] = [effect.summary, effect.equation, effect.signature].map(escape);
    format!(
        "<dl>\n<dt>Effect</dt><dd>{what}</dd>\n<dt>Law</dt><dd><code>{equation}</code></dd>\n\
         <dt>Signature</dt><dd>{signature}</dd>\n</dl>\n"
    )
}

fn law(finding: &Cause, data: &ReportData) -> String {
    let cause = (finding.effect.clone(), finding.scope.clone());
    let Some(law) = data.laws.iter().find(|law| law.cause == cause) else {
        return "<p class=\"note\">The plotted log lacks the quantities to plot this effect.</p>\n".to_owned();
    };
    let keys = key("mean", "without this cause: mean, central 68 %") + &key("law", "explained by this cause");
    let picture = plot::law(&law.bins, law.x_label, law.y_label);
    format!("<figure><figcaption><strong>Law in this log</strong>{keys}</figcaption>{picture}</figure>\n")
}

/// Returns the estimates with their intervals, plotted over the prior range.
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
    let prior = known.map_or([value, value], |known| known.prior_range);
    let picture = plot::whisker(value, [low, high], prior);
    let [value, low, high] = alike(numbers);
    let size = format!("{value} {unit}");
    let [from, to] = prior.map(|end| format!("{end}").replace('-', "−"));
    let range = known.map_or(String::new(), |_| format!("prior range for a Go2: {from} to {to} {unit}"));
    format!(
        "<div class=\"parameter\"><code>{label}</code> <strong>{}</strong>, 95 %: {low} to {high}\n{picture}\
         <span class=\"small\">{}</span></div>\n",
        size.trim_end(),
        range.trim_end()
    )
}

/// Returns value, lower and upper end of the interval of each component.
fn components(estimate: &Estimate) -> Vec<[f64; 3]> {
    let of = |value: &ParameterValue, index: usize| match value {
        ParameterValue::Number(number) => *number,
        ParameterValue::Vector(numbers) => numbers.get(index).copied().unwrap_or(f64::NAN),
    };
    let count = if let ParameterValue::Vector(numbers) = &estimate.value { numbers.len() } else { 1 };
    (0..count).map(|index| [&estimate.value, &estimate.low, &estimate.high].map(|end| of(end, index))).collect()
}

/// Returns the table of causes and alternative hypotheses, with the error reduction of each.
pub fn ranking(diagnosis: &Diagnosis) -> String {
    if diagnosis.findings.is_empty() {
        return String::new();
    }
    let mut rows = String::new();
    for (index, finding) in diagnosis.findings.iter().enumerate() {
        rows += &finding_row(index + 1, finding);
        rows.extend(finding.rivals.iter().map(|alternative| alternative_row(alternative, finding.held_out_gain)));
    }
    format!(
        "<section>\n<h2>Alternative hypotheses</h2>\n<div class=\"wide\"><table class=\"ranking\">\n\
         <thead><tr><th>hypothesis</th><th>error reduction, cross-validated</th><th></th>\
         <th>log-likelihood gain</th></tr></thead>\n\
         <tbody>\n{rows}</tbody></table></div>\n\
         <p class=\"note\">Error reduction: relative reduction of the RMSE in the channels that the effect acts on, \
         cross-validated. Each cause is added to those above it; its alternatives take its place. The log-likelihood \
         gain of a cause must exceed a threshold that is computed for each log.</p>\n</section>\n"
    )
}

fn finding_row(rank: usize, finding: &Cause) -> String {
    format!(
        "<tr class=\"winner\"><th scope=\"row\">{rank}. {}</th><td>{}</td><td>{}</td><td>{} \
         <span class=\"small\">nat, threshold {}</span></td></tr>\n",
        text::sentence(&text::cause(&finding.effect, &finding.scope)),
        bar(finding.held_out_gain, "gain"),
        percent(finding.held_out_gain),
        number(finding.score_nats),
        number(finding.threshold_nats)
    )
}

fn alternative_row(alternative: &AlternativeCause, gain: f64) -> String {
    let lost = 100.0 * (gain - alternative.held_out_gain);
    let verdict = if lost >= 0.5 { format!("{lost:.0} percentage points less") } else { "equal".to_owned() };
    format!(
        "<tr class=\"rival\"><th scope=\"row\">{}</th><td>{}</td><td>{}</td><td class=\"small\">{verdict}</td></tr>\n",
        text::cause(&alternative.effect, &alternative.scope),
        bar(alternative.held_out_gain, "lost"),
        percent(alternative.held_out_gain)
    )
}
