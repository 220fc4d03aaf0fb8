//! `twinstep fit --cross`: one ensemble per stage of a data collection, each evaluated on all stages.
//!
//! U2E, §IV-B and Fig. 2.

use std::fmt::Write;
use std::path::Path;

use twinstep_ensemble::{
    DataOptions, DataSet, Ensemble, EnsembleError, Gaussian, Sequence, Split, epistemic_uncertainty,
};
use twinstep_logs::Log;

use crate::failure::{Failure, input, other};
use crate::observer::Observer;
use twinstep_report::chart::{self, GREY, INK, Line, ORANGE, Panel, PlotError};

/// Width and height of one cell of the grid [px].
const CELL: (u32, u32) = (460, 340);
/// Fraction of a cell's height for the torque panel. The uncertainty panel is below it.
const TORQUE_SHARE: f64 = 0.62;

/// Evaluation of one ensemble on the test blocks of one stage.
struct Cell {
    /// Torque RMSE of the members' mean [N·m].
    rmse: f64,
    /// Mean epistemic uncertainty [nat].
    mean_uncertainty: f64,
    /// 95th percentile of the epistemic uncertainty [nat].
    uncertainty_p95: f64,
    /// Rows of the plotted sequence: time [s], measured and mean torque [N·m], epistemic uncertainty [nat].
    drawn: Vec<[f64; 4]>,
}

/// Evaluates an ensemble of each stage on all stages, and writes the grid to the folder `out`. Returns the table.
///
/// `train` returns the ensemble of a stage, which it stores in a file.
pub fn run(
    logs: &[(String, Log)],
    options: DataOptions,
    out: &Path,
    train: impl Fn(&DataSet, &Path) -> Result<Ensemble, Failure>,
    observer: &Observer,
) -> Result<String, Failure> {
    std::fs::create_dir_all(out).map_err(input)?;
    let [svg, csv] = ["cross.svg", "cross.csv"].map(|name| out.join(name));
    chart::check_writable(&svg).map_err(input)?;
    let names: Vec<&str> = logs.iter().map(|(name, _)| name.as_str()).collect();
    let stages = logs.iter().map(|log| DataSet::with_options(std::slice::from_ref(log), options).map_err(input));
    let stages: Vec<DataSet> = stages.collect::<Result<_, _>>()?;
    if let Some(index) = stages.iter().position(|stage| stage.joints != stages[0].joints) {
        return Err(input(EnsembleError::JointsMismatch { log: names[index].to_owned() }));
    }
    let mut ensembles = Vec::new();
    for (number, (stage, name)) in stages.iter().zip(&names).enumerate() {
        observer.note(format_args!("training on {name}"));
        ensembles.push(train(stage, &out.join(format!("{}.safetensors", number + 1)))?);
    }
    let cells: Vec<Vec<Cell>> =
        ensembles.iter().map(|ensemble| stages.iter().map(|stage| cell(ensemble, stage)).collect()).collect();
    chart::write(&picture(&cells, &names).map_err(other)?, &svg).map_err(other)?;
    let table = csv_text(&cells, &names);
    twinstep_files::write(&csv, &table).map_err(other)?;
    Ok(table)
}

fn cell(ensemble: &Ensemble, stage: &DataSet) -> Cell {
    let predicted = ensemble.predict(stage.runs(Split::Test));
    let (mut squares, mut uncertainties) = (0.0, Vec::new());
    let mut drawn = (0.0, Vec::new());
    for (run, rows) in stage.runs(Split::Test).zip(&predicted) {
        let evaluated = evaluated_rows(run, rows, stage.dt);
        squares += evaluated.iter().map(|[_, torque, mean, _]| (torque - mean).powi(2)).sum::<f64>();
        uncertainties.extend(evaluated.iter().map(|row| row[3]));
        // All ensembles plot the same sequence of a stage: the one with the largest torques.
        let power: f64 = evaluated.iter().map(|row| row[1] * row[1]).sum();
        if power > drawn.0 {
            drawn = (power, evaluated);
        }
    }
    uncertainties.sort_by(f64::total_cmp);
    let rows = uncertainties.len().max(1) as f64;
    Cell {
        rmse: (squares / rows).sqrt(),
        mean_uncertainty: uncertainties.iter().sum::<f64>() / rows,
        uncertainty_p95: uncertainties.get(uncertainties.len() * 19 / 20).copied().unwrap_or(0.0),
        drawn: drawn.1,
    }
}

/// Returns time, measured torque, mean torque and epistemic uncertainty of each row that has a prediction.
pub fn evaluated_rows(run: &Sequence, rows: &[Vec<Gaussian>], dt: f64) -> Vec<[f64; 4]> {
    let first = run.torques.len() - rows.len();
    let row = |(index, members): (usize, &Vec<Gaussian>)| {
        let (means, variances): (Vec<f64>, Vec<f64>) =
            members.iter().map(|member| (member.mean, member.variance)).unzip();
        let mean = means.iter().sum::<f64>() / means.len() as f64;
        [index as f64 * dt, run.torques[first + index], mean, epistemic_uncertainty(&means, &variances)]
    };
    rows.iter().enumerate().map(row).collect()
}

/// Returns the table as CSV, one line per cell.
fn csv_text(cells: &[Vec<Cell>], names: &[&str]) -> String {
    let mut text = "learnt_from,judged_by,torque_rmse_nm,euf_nat,euf_95_percent_nat\n".to_owned();
    for (row, name) in cells.iter().zip(names) {
        for (Cell { rmse, mean_uncertainty, uncertainty_p95, .. }, test_name) in row.iter().zip(names) {
            let _ = writeln!(text, "{name},{test_name},{rmse:.4},{mean_uncertainty:.4},{uncertainty_p95:.4}");
        }
    }
    text
}

/// Draws the grid: one row per ensemble, one column per stage that it is evaluated on.
fn picture(cells: &[Vec<Cell>], names: &[&str]) -> Result<String, PlotError> {
    let count = names.len();
    let size = (CELL.0 * count as u32, CELL.1 * count as u32 + 40);
    let all = || cells.iter().flatten().flat_map(|cell| &cell.drawn);
    let max_uncertainty = all().map(|row| row[3]).fold(0.1, f64::max);
    chart::picture(size, |root| {
        let (head, grid) = root.split_vertically(80);
        chart::legend(&head, &[("measured", INK), ("ensemble's mean", ORANGE), ("uncertainty", GREY)], 600, (160, 44))?;
        for (index, area) in grid.split_evenly((count, count)).iter().enumerate() {
            let (row, column) = (index / count, index % count);
            let cell = &cells[row][column];
            let of = |value: usize| cell.drawn.iter().map(|row| (row[0], row[value])).collect::<Vec<_>>();
            // One torque scale per column, because a column shows one sequence of one log.
            let torques = cells.iter().flat_map(|row| &row[column].drawn).flat_map(|row| [row[1], row[2]]);
            let end = cell.drawn.last().map_or(1.0, |row| row[0]).max(1e-3);
            let (above, below) = area.split_vertically((f64::from(2 * CELL.1) * TORQUE_SHARE) as u32);
            Panel {
                caption: format!("{} on {}: RMSE {:.3} N·m", short(names[row]), short(names[column]), cell.rmse),
                x_label: "",
                y_label: "torque [N·m]",
                x: 0.0..end,
                y: chart::range(torques),
                lines: vec![
                    Line { colour: INK, width: 3, pieces: vec![of(1)] },
                    Line { colour: ORANGE, width: 3, pieces: vec![of(2)] },
                ],
            }
            .draw(&above)?;
            Panel {
                caption: format!("mean uncertainty {:.3} nat", cell.mean_uncertainty),
                x_label: "",
                y_label: "[nat]",
                x: 0.0..end,
                y: 0.0..max_uncertainty,
                lines: vec![Line { colour: GREY, width: 4, pieces: vec![of(3)] }],
            }
            .draw(&below)?;
        }
        Ok(())
    })
}

/// Returns the file name without folder and extension.
fn short(name: &str) -> &str {
    Path::new(name).file_stem().and_then(|stem| stem.to_str()).unwrap_or(name)
}
