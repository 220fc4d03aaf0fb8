//! Lower part of the page: ambiguous causes, gains of the joints, unexplained residual and provenance.

use twinstep_diagnose::{Cause, CorrelatedPair, Diagnosis, NextExperiment, RmsErrors};
use twinstep_effects::Effect;
use twinstep_model::Joint;

use crate::html::{escape, number, percent};
use crate::report_data::{LogFacts, Provenance};
use crate::text;

/// Returns the section on ambiguous causes and the next experiment.
pub fn confusions(diagnosis: &Diagnosis) -> String {
    let doubtful = diagnosis.findings.iter().filter(|finding| !finding.ambiguous_with.is_empty());
    let items = diagnosis.confusable.iter().map(pair).chain(doubtful.map(ambiguous)).collect::<String>();
    let text = if items.is_empty() {
        "<p>None: no two causes explain this log equally well.</p>\n".to_owned()
    } else {
        format!("<ul class=\"confusions\">\n{items}</ul>\n")
    };
    let next = diagnosis.next_experiment.as_ref().map_or(String::new(), experiment);
    format!("<section>\n<h2>Ambiguous causes and the next experiment</h2>\n{text}{next}</section>\n")
}

/// Returns the paragraph on the proposed motion file.
fn experiment(next: &NextExperiment) -> String {
    let (motion, text) = (escape(&next.motion), escape(&next.text));
    format!(
        "<p><strong>Next experiment: <code>{motion}</code>.</strong> {text}</p>\n\
         <p class=\"note\">For the prediction every safe motion is simulated with each cause, and the size of the \
         other cause is refitted to imitate it. Execute the motion with <code>twinstep play</code> or on the robot, \
         then diagnose both logs together.</p>\n"
    )
}

fn pair(pair: &CorrelatedPair) -> String {
    let [one, other] = pair.effects.each_ref().map(|effect| text::cause_at(effect));
    let (one, correlation, next) = (text::sentence(&one), number(pair.correlation), escape(&pair.experiment));
    format!(
        "<li>Highly correlated: <strong>{one} and {other}</strong> (correlation {correlation}). Suggested experiment: \
         {next}</li>\n"
    )
}

fn ambiguous(finding: &Cause) -> String {
    let name = text::sentence(&text::cause(&finding.effect, &finding.scope));
    let others = text::listed(finding.ambiguous_with.iter().map(|other| text::cause_at(other)));
    let next = experiments(&finding.effect, &finding.ambiguous_with);
    let next = if next.is_empty() { next } else { format!(" Suggested experiment: {next}") };
    format!("<li><strong>{name}</strong> is not distinguishable from {others} with this log.{next}</li>\n")
}

/// Returns the catalogue's experiments that discriminate between an effect and others.
fn experiments(effect: &str, others: &[String]) -> String {
    let among = |name: &str| others.iter().any(|other| other.split('@').next() == Some(name));
    let confounders = Effect::named(effect).map_or(&[][..], |effect| effect.confounders);
    let known = confounders.iter().filter(|confounder| among(confounder.effect));
    known.map(|confounder| escape(confounder.discriminating_experiment)).collect::<Vec<_>>().join(" ")
}

/// Returns the section on gains that differ from joint to joint; empty if they do not.
pub fn joint_gains(diagnosis: &Diagnosis) -> String {
    let Some([kp, kd]) = diagnosis.joint_gain_ranges() else { return String::new() };
    let range = |[low, high]: [f64; 2]| format!("{} to {}", number(low), number(high));
    let row = |joint: Joint| {
        let [kp, kd] = diagnosis.joint_gains.get(joint.name())?;
        Some(format!(
            "<tr><th scope=\"row\">{}</th><td>{}</td><td>{}</td></tr>\n",
            joint.name(),
            number(*kp),
            number(*kd)
        ))
    };
    format!(
        "<section>\n<h2>Gains of the joints</h2>\n<p>The position gains are {} times those that the given model and the \
         causes have, the velocity gains {} times. Gains of equal motors differ by as much, so this is no cause. The \
         extended model has these gains.</p>\n\
         <div class=\"wide\"><table class=\"numbers\">\n<thead><tr><th></th><th>kp</th><th>kd</th></tr></thead>\n{}</table></div>\n</section>\n",
        range(kp),
        range(kd),
        Joint::ALL.into_iter().filter_map(row).collect::<String>()
    )
}

/// Returns the section on the residual that no cause explains.
pub fn unexplained(diagnosis: &Diagnosis) -> String {
    let residual = &diagnosis.unexplained;
    let channels = text::listed(residual.depends_on.iter().map(|channel| format!("<code>{}</code>", escape(channel))));
    let depends = if channels.is_empty() { String::new() } else { format!(" It depends on {channels}.") };
    let text = if residual.text.is_empty() { String::new() } else { format!("<p>{}</p>\n", escape(&residual.text)) };
    format!(
        "<section>\n<h2>Unexplained residual</h2>\n<p><strong>{}</strong> of the given model's residual power above \
         noise is unexplained.{depends}</p>\n{text}</section>\n",
        percent(residual.fraction)
    )
}

/// Returns the section on the networks that have learned what no cause explains; empty without them.
pub fn learned_residual(diagnosis: &Diagnosis) -> String {
    let Some(learned) = &diagnosis.learned_residual else { return String::new() };
    let line = |name: &str, of: fn(&RmsErrors) -> Option<f64>| match (of(&learned.before), of(&learned.after)) {
        (Some(before), Some(after)) => {
            format!("<li>{name}: {} before, <strong>{}</strong> after</li>\n", number(before), number(after))
        }
        _ => String::new(),
    };
    let (ensemble, tap) = (escape(&learned.ensemble), escape(&learned.tap));
    let (torque, speed) = (number(learned.max_torque_nm), number(learned.max_speed_rad_s));
    format!(
        "<section>\n<h2>Learned residual</h2>\n<p>No law of the catalogue explains what is left. The networks of \
         <code>{ensemble}</code> have learned the missing torque from the torque that was asked for and the joint \
         velocity. The extended model adds it at <code>{tap}</code>, and every law stays.</p>\n<p>On held-out blocks, \
         on which they were not trained:</p>\n<ul>\n{}{}</ul>\n<p><strong>Where it does not know.</strong> The training \
         data contain torques up to {torque} N·m and speeds up to {speed} rad/s.{} Beyond these limits do not rely on \
         them.</p>\n\
         <p><strong>What to do.</strong> Use the extended model for motions like these. A law that is missing from the \
         catalogue generalises better: look at what the residual depends on.</p>\n</section>\n",
        line("joint position [rad]", |errors| errors.q_rmse_rad),
        line("torque [N·m]", |errors| errors.torque_rmse_nm),
        learned.uncertainty_ratio.map_or(String::new(), |ratio| format!(
            " On the held-out blocks the networks disagree {} times as much as on their training data.",
            number(ratio)
        )),
    )
}

/// Returns the footer with the provenance of the report.
pub fn provenance(diagnosis: &Diagnosis, provenance: &Provenance) -> String {
    let entry = |name: &str, text: String| format!("<dt>{name}</dt><dd>{text}</dd>\n");
    let code = |text: &str| format!("<code>{}</code>", escape(text));
    let list = [
        provenance.logs.iter().map(|log| entry("Log", facts(log))).collect(),
        entry("Robot and simulation", text::listed(provenance.motions.iter().map(|file| code(file)))),
        entry("Given model", code(&provenance.model)),
        entry("Extended model", code(&diagnosis.extended_model)),
        entry("Command", code(&provenance.command)),
        entry("Version", format!("twinstep {}", env!("CARGO_PKG_VERSION"))),
        entry("Date", escape(&provenance.date)),
    ];
    format!("<footer>\n<h2>Provenance</h2>\n<dl>\n{}</dl>\n</footer>\n", list.concat())
}

fn facts(log: &LogFacts) -> String {
    let LogFacts { name, rows, duration_s, rate_hz, segments } = log;
    let segments = text::listed(segments.iter().map(|segment| format!("<code>{}</code>", escape(segment))));
    format!("<code>{}</code>: {rows} rows, {duration_s:.1} s at {rate_hz} Hz, {segments}", escape(name))
}
