//! Upper part of the page: headline, errors, and the joints and times at which they are largest.

use twinstep_diagnose::{Diagnosis, Promise, RmsErrors};
use twinstep_identify::{Evaluation, JointEvaluation};
use twinstep_model::{Joint, JointKind, Leg};

use crate::html::{alike, escape, percent};
use crate::report_data::ReportData;
use crate::time_series::Curve;
use crate::{plot, text};

/// Minimum error of the darkest colour [rad, N·m], so that rounding errors have no colour.
const MIN_SCALE: f64 = 1e-3;

/// Function that returns an error of a joint, if it is known.
type JointErrorFn = fn(&JointEvaluation) -> Option<f64>;

/// Returns the header with the headline.
pub fn headline(diagnosis: &Diagnosis, data: &ReportData) -> String {
    let (log, verdict) = (plotted_log(data), text::verdict(diagnosis));
    format!("<header>\n<p class=\"kicker\">Diagnosis of {log}</p>\n<h1>{verdict}</h1>\n</header>\n")
}

/// Returns the table of both models' errors and the noise floor.
pub fn numbers(diagnosis: &Diagnosis) -> String {
    let Diagnosis { baseline, extended, noise_floor, .. } = diagnosis;
    let row = |name: &str, of: fn(&RmsErrors) -> Option<f64>| {
        let [before, after, floor] = [baseline, extended, noise_floor].map(of);
        let gain = before.zip(after).and_then(|(before, after)| text::gain(before, after));
        let cells = alike([before, after, floor].map(|value| value.unwrap_or(f64::NAN)));
        let cells = cells.map(|cell| format!("<td>{cell}</td>")).concat();
        let gain = gain.map_or("–".to_owned(), percent);
        format!("<tr><th scope=\"row\">{name}</th>{cells}<td><strong>{gain}</strong></td></tr>\n")
    };
    format!(
        "<section>\n<h2>Error on held-out blocks</h2>\n<div class=\"wide\"><table class=\"numbers\">\n\
         <thead><tr><th></th><th>given model</th><th>extended model</th><th>noise floor</th><th>reduction</th></tr>\
         </thead>\n<tbody>\n{}{}</tbody></table></div>\n\
         <p class=\"note\">Root mean squares on the held-out blocks, which take no part in any selection or fit. A \
         dash: not measured in this log. The noise floor is the error due to sensor noise alone.</p>\n{}</section>\n",
        row("joint position, closed loop [rad]", |errors| errors.q_rmse_rad),
        row("torque at the sensor [N·m]", |errors| errors.torque_rmse_nm),
        diagnosis.promise.as_ref().map_or(String::new(), promise)
    )
}

/// Returns the paragraph on the predicted change of the error.
fn promise(promise: &Promise) -> String {
    let [predicted, low, high, found] = promise.all.changes().map(signed_percent);
    format!(
        "<p>The laws alone change the error of the joint positions by <strong>{found}</strong>. The prediction, made from \
         the fitted rows before this was measured, was {predicted} (90 % interval {low} to {high}).</p>\n"
    )
}

/// Returns a relative change as text.
fn signed_percent(change: f64) -> String {
    let percent = (100.0 * change).round();
    let sign = if percent > 0.0 {
        "+"
    } else if percent < 0.0 {
        "−"
    } else {
        ""
    };
    format!("{sign}{:.0} %", percent.abs())
}

/// Returns heat maps of the joints' errors under both models.
pub fn heat_maps(data: &ReportData) -> String {
    let quantities: [(&str, JointErrorFn); 2] =
        [("joint position [rad]", |joint| joint.q_rmse_rad), ("torque [N·m]", |joint| joint.torque_rmse_nm)];
    let mut maps = String::new();
    for (name, of) in quantities {
        let both = [&data.before, &data.after];
        let errors = both.iter().flat_map(|evaluation| evaluation.per_joint.values()).filter_map(of);
        let Some(worst) = errors.filter(|error| error.is_finite()).reduce(f64::max) else { continue };
        let worst = worst.max(MIN_SCALE);
        // Without causes both models are the same, and one map is enough.
        let count = if data.before == data.after { 1 } else { 2 };
        for (model, evaluation) in ["given model", "extended model"].into_iter().zip(both).take(count) {
            maps += &heat_map(&format!("{name}, {model}"), evaluation, of, worst);
        }
    }
    if maps.is_empty() {
        return String::new();
    }
    format!(
        "<section>\n<h2>Error per joint</h2>\n<div class=\"pair\">\n{maps}</div>\n\
         <p class=\"note\">Root mean square error of each joint over the whole of {}. All maps of a quantity have the \
         same colour scale. Grey: not in the log.</p>\n</section>\n",
        plotted_log(data)
    )
}

fn heat_map(name: &str, evaluation: &Evaluation, of: JointErrorFn, worst: f64) -> String {
    let cell = |leg: Leg, kind: JointKind| {
        let error = evaluation.per_joint.get(Joint { leg, kind }.name()).and_then(of);
        match error {
            None => "<td class=\"cell absent\">–</td>".to_owned(),
            Some(error) => {
                let share = if error.is_finite() { error / worst } else { 1.0 };
                let [error, _] = alike([error, worst]);
                format!("<td class=\"cell\" style=\"--share:{:.0}%\">{error}</td>", 100.0 * share)
            }
        }
    };
    let rows = Leg::ALL.map(|leg| {
        let cells = JointKind::ALL.map(|kind| cell(leg, kind)).concat();
        format!("<tr><th scope=\"row\">{}</th>{cells}</tr>\n", leg.name())
    });
    format!(
        "<table class=\"heat\"><caption>{name}</caption>\n\
         <thead><tr><th></th><th>hip</th><th>thigh</th><th>calf</th></tr></thead>\n<tbody>\n{}</tbody></table>\n",
        rows.concat()
    )
}

/// Returns the plots of the worst joint over time.
pub fn strips(data: &ReportData) -> String {
    let mut figures = String::new();
    for strip in &data.strips {
        let joint = strip.joint;
        figures += &figure(&format!("{joint}, where the error is largest"), &strip.close, strip.label);
        figures +=
            &figure(&format!("{joint}, error over the whole log"), &strip.errors, &format!("error of {}", strip.label));
    }
    if figures.is_empty() {
        return String::new();
    }
    format!("<section>\n<h2>Error over time (worst joint)</h2>\n<div class=\"pair\">\n{figures}</div>\n</section>\n")
}

fn figure(caption: &str, curves: &[Curve], y_label: &str) -> String {
    let keys = curves.iter().map(|curve| key(curve.class, curve.name)).collect::<String>();
    let picture = plot::curves(curves, y_label);
    format!("<figure><figcaption><strong>{caption}</strong>{keys}</figcaption>{picture}</figure>\n")
}

/// Returns an entry of a legend.
pub fn key(class: &str, name: &str) -> String {
    format!("<span class=\"key\"><span class=\"sample {class}\"></span>{name}</span>")
}

/// Returns the name of the plotted log.
fn plotted_log(data: &ReportData) -> String {
    let first = data.provenance.logs.first();
    first.map_or("the log".to_owned(), |log| format!("<code>{}</code>", escape(&log.name)))
}
