//! The lower part of the page: what cannot be told apart, what is left, and where it all comes from.

use twinstep_diagnose::{Cause, CorrelatedPair, Diagnosis, NextExperiment};
use twinstep_effects::Effect;

use crate::html::{escape, number, percent};
use crate::report_data::{LogFacts, Provenance};
use crate::text;

/// What this log cannot tell apart, and what to run next.
pub fn confusions(diagnosis: &Diagnosis) -> String {
    let doubtful = diagnosis.findings.iter().filter(|finding| !finding.ambiguous_with.is_empty());
    let items = diagnosis.confusable.iter().map(pair).chain(doubtful.map(ambiguous)).collect::<String>();
    let text = if items.is_empty() {
        "<p>Nothing that matters here: no two causes explain this log equally well.</p>\n".to_owned()
    } else {
        format!("<ul class=\"confusions\">\n{items}</ul>\n")
    };
    let next = diagnosis.next_experiment.as_ref().map_or(String::new(), experiment);
    format!("<section>\n<h2>What this log cannot tell apart, and what to run next</h2>\n{text}{next}</section>\n")
}

/// The motion that is written beside the page.
fn experiment(next: &NextExperiment) -> String {
    let (motion, text) = (escape(&next.motion), escape(&next.text));
    format!(
        "<p><strong>Next experiment: <code>{motion}</code>.</strong> {text}</p>\n\
         <p class=\"note\">Predicted by simulating every safe motion with either cause, after the other has taken the size \
         that mimics it best. Play it, then diagnose both logs together.</p>\n"
    )
}

fn pair(pair: &CorrelatedPair) -> String {
    let [one, other] = pair.effects.each_ref().map(|effect| text::cause_at(effect));
    let (one, correlation, next) = (text::sentence(&one), number(pair.correlation), escape(&pair.experiment));
    format!("<li><strong>{one} or {other}</strong> (correlation {correlation}). Next: {next}</li>\n")
}

fn ambiguous(finding: &Cause) -> String {
    let name = text::sentence(&text::cause(&finding.effect, &finding.scope));
    let others = text::listed(finding.ambiguous_with.iter().map(|other| text::cause_at(other)));
    let next = experiments(&finding.effect, &finding.ambiguous_with);
    let next = if next.is_empty() { next } else { format!(" Next: {next}") };
    format!("<li><strong>{name}</strong> explains as much as {others}.{next}</li>\n")
}

/// What the catalogue proposes to tell an effect from others.
fn experiments(effect: &str, others: &[String]) -> String {
    let among = |name: &str| others.iter().any(|other| other.split('@').next() == Some(name));
    let confusions = Effect::named(effect).map_or(&[][..], |effect| effect.confounders);
    let known = confusions.iter().filter(|confusion| among(confusion.effect));
    known.map(|confusion| escape(confusion.discriminating_experiment)).collect::<Vec<_>>().join(" ")
}

/// What no finding explains.
pub fn unexplained(diagnosis: &Diagnosis) -> String {
    let left = &diagnosis.unexplained;
    let channels = text::listed(left.depends_on.iter().map(|channel| format!("<code>{}</code>", escape(channel))));
    let depends = if channels.is_empty() { String::new() } else { format!(" It depends on {channels}.") };
    let text = if left.text.is_empty() { String::new() } else { format!("<p>{}</p>\n", escape(&left.text)) };
    format!(
        "<section>\n<h2>What is left</h2>\n<p><strong>{}</strong> of the residual power above the noise floor is \
         unexplained.{depends}</p>\n{text}</section>\n",
        percent(left.fraction)
    )
}

/// Where the page comes from.
pub fn provenance(diagnosis: &Diagnosis, provenance: &Provenance) -> String {
    let entry = |name: &str, text: String| format!("<dt>{name}</dt><dd>{text}</dd>\n");
    let code = |text: &str| format!("<code>{}</code>", escape(text));
    let list = [
        provenance.logs.iter().map(|log| entry("Log", facts(log))).collect(),
        entry("Model given", code(&provenance.model)),
        entry("Extended model", code(&diagnosis.extended_model)),
        entry("Command", code(&provenance.command)),
        entry("Version", format!("twinstep {}", env!("CARGO_PKG_VERSION"))),
        entry("Date", escape(&provenance.date)),
    ];
    format!("<footer>\n<h2>Where this comes from</h2>\n<dl>\n{}</dl>\n</footer>\n", list.concat())
}

fn facts(log: &LogFacts) -> String {
    let LogFacts { name, rows, duration_s, rate_hz, segments } = log;
    let segments = text::listed(segments.iter().map(|segment| format!("<code>{}</code>", escape(segment))));
    format!("<code>{}</code>: {rows} rows, {duration_s:.1} s at {rate_hz} Hz, {segments}", escape(name))
}
