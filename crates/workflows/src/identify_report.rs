//! Table of identified parameters.

use twinstep_identify::{EstimateStatus, Identification, ParameterEstimate};

/// Returns a table with one line per parameter, and the highly correlated pairs.
pub fn table(found: &Identification) -> String {
    let mut lines = vec![format!("{:<44}  {:>10}  95 % interval", "", "value")];
    for finding in &found.findings {
        let interval = finding.interval.map_or(String::new(), |[low, high]| format!("{low:.4} to {high:.4}"));
        let remark = match finding.verdict {
            EstimateStatus::Identified => "",
            EstimateStatus::AtBound => "at its bound: the true value may lie outside",
            EstimateStatus::NotIdentifiable => "not identifiable from this log; kept at its initial value",
        };
        let (name, value) = (finding.parameter.name(), finding.value);
        let line = format!("{name:<44}  {value:>10.4}  {interval:<22} {} {remark}", finding.parameter.unit);
        lines.push(line.trim_end().to_owned());
    }
    lines.extend(found.findings.iter().filter_map(reading));
    for (one, other, correlation, experiment) in &found.correlated {
        lines.push(format!("highly correlated: {one} and {other} (correlation {correlation:.2})"));
        lines.extend(experiment.map(|experiment| format!("    suggested experiment: {experiment}")));
    }
    lines.push(format!("residuals: {:.2} -> {:.2} times the noise (RMS)\n", found.rms[0], found.rms[1]));
    lines.join("\n")
}

/// Returns a log-Cholesky coordinate as mass or centre of mass. Returns `None` for other parameters.
fn reading(finding: &ParameterEstimate) -> Option<String> {
    let parameter = &finding.parameter;
    let (name, unit, convert): (_, _, fn(f64) -> f64) = match parameter.parameter_name.as_str() {
        "theta.0" => ("mass", "kg", |alpha| (2.0 * alpha).exp()),
        "theta.7" => ("centre of mass, x", "m", |t| t),
        "theta.8" => ("centre of mass, y", "m", |t| t),
        "theta.9" => ("centre of mass, z", "m", |t| t),
        _ => return None,
    };
    let [low, high] = finding.interval?.map(convert);
    Some(format!("{} of the {}: {:.4} {unit} ({low:.4} to {high:.4})", name, parameter.scope, convert(finding.value)))
}
