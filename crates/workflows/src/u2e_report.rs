//! Report of `twinstep u2e`, written again after every iteration: Markdown, and a page with plots.

use std::fmt::Write;
use std::path::Path;

use twinstep_report::chart::{self, INK, Line, ORANGE, Panel, PlotError};

use crate::failure::{Failure, other};
use crate::stages;
use crate::u2e_config::{U2eConfig, relative_decrease};
use crate::u2e_evaluation::{Errors, Evaluation};

/// Width and height of the plots [px].
const SIZE: (u32, u32) = (900, 640);
/// Seconds after which a browser loads a page again that grows.
const RELOAD_S: u32 = 10;

/// Writes `report.md` and `progress.html` to the folder `out`, and returns the text of the report.
pub fn write(config: &U2eConfig, out: &Path, evaluations: &[Evaluation], converged: bool) -> Result<String, Failure> {
    let is_last = converged || evaluations.len() > config.iterations;
    let end = match (converged, is_last) {
        (true, _) => format!("The uncertainty of new data decreases by less than {}: the end.", config.threshold),
        (_, true) => format!("The end after {} iterations.", config.iterations),
        _ => "It continues.".to_owned(),
    };
    let report = format!("# U2E\n\n{end}\n\n{}\n{}", iterations(evaluations), cross_table(evaluations));
    stages::write(&out.join("report.md"), report.as_bytes())?;
    let svg = picture(evaluations).map_err(other)?;
    let page = page(&report, &svg, is_last);
    stages::write(&out.join("progress.html"), page.as_bytes())?;
    Ok(report)
}

/// Returns the table of the iterations.
fn iterations(evaluations: &[Evaluation]) -> String {
    let mut text = "Robot time and falls are totals. The uncertainty of a log is that of the ensemble before it.\n\n\
                    | iteration | robot time [min] | falls | torques at the limit | uncertainty [nat] | decrease | \
                    held-out torque RMSE [N·m] | held-out uncertainty [nat] |\n|---|---|---|---|---|---|---|---|\n"
        .to_owned();
    let (mut uncertainties, mut falls) = (Vec::new(), 0);
    for (evaluation, minutes) in evaluations.iter().zip(minutes(evaluations)) {
        let Evaluation { name, collection, uncertainty, held_out, .. } = evaluation;
        falls += collection.falls;
        uncertainties.extend(*uncertainty);
        let decrease = uncertainty.and_then(|_| relative_decrease(&uncertainties));
        let decrease = decrease.map_or("-".to_owned(), |decrease| format!("{:.0} %", 100.0 * decrease));
        let [rmse, euf] = [held_out.map(|errors| errors.torque_rmse_nm), held_out.map(|errors| errors.uncertainty_nat)];
        let share = 100.0 * collection.torque_limit_share;
        let _ = writeln!(
            text,
            "| {name} | {minutes:.2} | {falls} | {share:.2} % | {} | {decrease} | {} | {} |",
            cell(*uncertainty),
            cell(rmse),
            cell(euf)
        );
    }
    text
}

/// Returns the table of all ensembles on the test splits of all logs (U2E, Fig. 2).
fn cross_table(evaluations: &[Evaluation]) -> String {
    let mut text =
        "Torque RMSE [N·m] (mean uncertainty [nat]) on the test split of each log.\n\n| ensemble of |".to_owned();
    for evaluation in evaluations {
        let _ = write!(text, " {} |", evaluation.name);
    }
    let _ = writeln!(text, "\n|---|{}", "---|".repeat(evaluations.len()));
    for (row, evaluation) in evaluations.iter().enumerate() {
        let _ = write!(text, "| {} |", evaluation.name);
        for (column, tested) in evaluations.iter().enumerate() {
            let errors = if column <= row { evaluation.on_logs[column] } else { tested.earlier_on_new_log[row] };
            let cell = errors.map_or("-".to_owned(), |Errors { torque_rmse_nm, uncertainty_nat }| {
                format!("{torque_rmse_nm:.3} ({uncertainty_nat:.4})")
            });
            let _ = write!(text, " {cell} |");
        }
        text.push('\n');
    }
    text
}

fn cell(value: Option<f64>) -> String {
    value.map_or("-".to_owned(), |value| format!("{value:.4}"))
}

/// Returns the robot time at the end of each iteration [min].
fn minutes(evaluations: &[Evaluation]) -> impl Iterator<Item = f64> {
    evaluations.iter().scan(0.0, |seconds, evaluation| {
        *seconds += evaluation.collection.seconds;
        Some(*seconds / 60.0)
    })
}

/// Draws uncertainty and torque error over the robot time.
fn picture(evaluations: &[Evaluation]) -> Result<String, PlotError> {
    let over_time = |value: &dyn Fn(&Evaluation) -> Option<f64>| -> Vec<(f64, f64)> {
        evaluations.iter().zip(minutes(evaluations)).filter_map(|(one, time)| Some((time, value(one)?))).collect()
    };
    let end = minutes(evaluations).last().unwrap_or(1.0);
    let panel = |caption: &str, x_label, y_label, colour, points: Vec<(f64, f64)>| Panel {
        caption: caption.to_owned(),
        x_label,
        y_label,
        x: 0.0..end,
        y: 0.0..points.iter().map(|(_, y)| 1.1 * y).fold(1e-3, f64::max),
        lines: vec![Line { colour, width: 4, pieces: vec![points] }],
    };
    let rmse = |one: &Evaluation| {
        one.held_out.or_else(|| one.on_logs.last().copied().flatten()).map(|errors| errors.torque_rmse_nm)
    };
    let has_held_out = evaluations.iter().any(|evaluation| evaluation.held_out.is_some());
    let judged = if has_held_out { "held-out log" } else { "test split of the newest log" };
    chart::picture(SIZE, |root| {
        let (top, bottom) = root.split_vertically(SIZE.1);
        let uncertainty = over_time(&|one| one.uncertainty);
        panel("Uncertainty of a new log, by the ensemble before it", "", "[nat]", ORANGE, uncertainty).draw(&top)?;
        let caption = format!("Torque RMSE on the {judged}");
        panel(&caption, "robot time [min]", "[N·m]", INK, over_time(&rmse)).draw(&bottom)
    })
}

/// Returns the page: plots and tables. It loads itself again until the end.
fn page(report: &str, svg: &str, is_last: bool) -> String {
    let reload = if is_last { String::new() } else { format!("<meta http-equiv=\"refresh\" content=\"{RELOAD_S}\">") };
    let mut body = String::new();
    for line in report.lines().filter(|line| !line.starts_with("|---")) {
        let cells = line.trim_matches('|').replace('|', "</td><td>");
        let _ = match (line.strip_prefix("# "), line.starts_with('|')) {
            (Some(title), _) => writeln!(body, "<h1>{title}</h1>"),
            (_, true) => writeln!(body, "<table><tr><td>{cells}</td></tr></table>"),
            _ => writeln!(body, "<p>{line}</p>"),
        };
    }
    // Rows of one table follow each other.
    let body = body.replace("</table>\n<table>", "\n");
    format!(
        "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\"><title>U2E</title>{reload}\n<style>\
         body {{ font: 16px/1.5 sans-serif; max-width: 60rem; margin: 2rem auto; padding: 0 1rem; color: #262626 }}\n\
         table {{ border-collapse: collapse; margin: 1rem 0 }} td {{ border-bottom: 1px solid #e6e6e6; padding: 0.3rem 0.8rem \
         0.3rem 0 }} tr:first-child {{ font-weight: 600 }}</style></head>\n<body>\n{body}{svg}\n</body></html>\n"
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::u2e_evaluation::Collection;

    fn evaluation(name: &str, uncertainty: Option<f64>, earlier: usize) -> Evaluation {
        let errors = Some(Errors { torque_rmse_nm: 0.5, uncertainty_nat: 0.02 });
        Evaluation {
            name: name.to_owned(),
            collection: Collection { seconds: 30.0, falls: 1, torque_limit_share: 0.01 },
            uncertainty,
            earlier_on_new_log: vec![None; earlier],
            on_logs: vec![errors; earlier + 1],
            held_out: errors,
        }
    }

    #[test]
    fn tables_have_totals_and_a_row_for_each_ensemble() {
        let evaluations = [
            evaluation("0-base", None, 0),
            evaluation("1-explore", Some(0.4), 1),
            evaluation("2-explore", Some(0.3), 2),
        ];
        let text = iterations(&evaluations);
        assert!(text.contains("| 0-base | 0.50 | 1 | 1.00 % | - | - | 0.5000 | 0.0200 |"), "{text}");
        assert!(text.contains("| 2-explore | 1.50 | 3 | 1.00 % | 0.3000 | 25 % | 0.5000 | 0.0200 |"), "{text}");
        let cross = cross_table(&evaluations);
        assert!(cross.contains("| 1-explore | 0.500 (0.0200) | 0.500 (0.0200) | - |"), "{cross}");
        let page = page(&text, &picture(&evaluations).expect("drawn"), false);
        assert!(page.contains("refresh") && page.matches("<table>").count() == 1 && page.contains("<svg"), "{page}");
    }
}
