//! `twinstep fit --cross`: ensembles that learnt from stages of a collection of data, each judged by all of them (U2E §IV-B,
//! Fig. 2).

use std::fmt::Write;
use std::path::{Path, PathBuf};

use twinstep_ensemble::{Split, Checkpoint, DataSet, Ensemble, EnsembleError, Gaussian, Sequence, epistemic_uncertainty};
use twinstep_logs::Log;

use twinstep_report::chart::{self, GREY, INK, Line, ORANGE, Panel, PlotError};
use crate::exit::{Failure, CommandResult, input, other};
use crate::fit::{Args, train_and_save, training_file};

/// Width and height of a cell of the grid [px].
const CELL: (u32, u32) = (460, 340);
/// Share of a cell that shows torque; uncertainty is below.
const TORQUE_SHARE: f64 = 0.62;

/// An ensemble on the left-out stretches of a stage.
struct Cell {
    /// Of the members' mean [N·m].
    rmse: f64,
    /// Mean of the disagreement [nat].
    mean_uncertainty: f64,
    /// The disagreement that one row in twenty exceeds [nat].
    uncertainty_p95: f64,
    /// Of the stretch that is drawn, row by row: time [s], measured torque, mean [N·m], disagreement [nat].
    drawn: Vec<[f64; 4]>,
}

/// Learns from each stage, judges by all, and writes the grid.
pub fn run(logs: &[(String, Log)], args: &Args) -> CommandResult {
    std::fs::create_dir_all(&args.out).map_err(input)?;
    let [svg, csv] = ["cross.svg", "cross.csv"].map(|name| args.out.join(name));
    chart::check_writable(&svg).map_err(input)?;
    let names: Vec<&str> = logs.iter().map(|(name, _)| name.as_str()).collect();
    let stages = logs.iter().map(|log| DataSet::smoothed(std::slice::from_ref(log), args.smooth).map_err(input));
    let stages: Vec<DataSet> = stages.collect::<Result<_, _>>()?;
    if let Some(place) = stages.iter().position(|stage| stage.joints != stages[0].joints) {
        return Err(input(EnsembleError::JointsMismatch { log: names[place].to_owned() }));
    }
    let mut ensembles = Vec::new();
    for (number, (stage, name)) in stages.iter().zip(&names).enumerate() {
        println!("learning from {name}");
        ensembles.push(train_or_load(stage, args, &args.out.join(format!("{}.safetensors", number + 1)))?);
    }
    let cells: Vec<Vec<Cell>> =
        ensembles.iter().map(|ensemble| stages.iter().map(|stage| cell(ensemble, stage)).collect()).collect();
    chart::write(&picture(&cells, &names).map_err(other)?, &svg).map_err(other)?;
    let numbers = numbers(&cells, &names);
    std::fs::write(&csv, &numbers).map_err(other)?;
    print!("{numbers}");
    println!("written to {}", args.out.display());
    Ok(())
}

/// The ensemble of a stage; with --resume one that is done is read, and one that is not goes on.
fn train_or_load(stage: &DataSet, args: &Args, out: &Path) -> Result<Ensemble, Failure> {
    let saved: PathBuf = training_file(out);
    if args.resumes() && out.exists() && !saved.exists() {
        let ensemble = Ensemble::read(out).map_err(input)?;
        if ensemble.description.data_hash == stage.hash() {
            return Ok(ensemble);
        }
    }
    let resume = (args.resumes() && saved.exists()).then(|| Checkpoint::read(&saved)).transpose().map_err(input)?;
    Ok(train_and_save(stage, args, out, resume)?.0)
}

fn cell(ensemble: &Ensemble, stage: &DataSet) -> Cell {
    let predicted = ensemble.predict(stage.runs(Split::Test));
    let (mut squares, mut eufs) = (0.0, Vec::new());
    let mut drawn = (0.0, Vec::new());
    for (run, rows) in stage.runs(Split::Test).zip(&predicted) {
        let judged = judged(run, rows, stage.dt);
        squares += judged.iter().map(|[_, torque, mean, _]| (torque - mean).powi(2)).sum::<f64>();
        eufs.extend(judged.iter().map(|row| row[3]));
        // The same stretch in a whole column: the one with the largest torques.
        let power: f64 = judged.iter().map(|row| row[1] * row[1]).sum();
        if power > drawn.0 {
            drawn = (power, judged);
        }
    }
    eufs.sort_by(f64::total_cmp);
    let rows = eufs.len().max(1) as f64;
    Cell {
        rmse: (squares / rows).sqrt(),
        mean_uncertainty: eufs.iter().sum::<f64>() / rows,
        uncertainty_p95: eufs.get(eufs.len() * 19 / 20).copied().unwrap_or(0.0),
        drawn: drawn.1,
    }
}

/// Time, measured torque, mean and disagreement of each row that has a prediction.
fn judged(run: &Sequence, rows: &[Vec<Gaussian>], dt: f64) -> Vec<[f64; 4]> {
    let first = run.torques.len() - rows.len();
    let row = |(index, members): (usize, &Vec<Gaussian>)| {
        let (means, variances): (Vec<f64>, Vec<f64>) =
            members.iter().map(|member| (member.mean, member.variance)).unzip();
        let mean = means.iter().sum::<f64>() / means.len() as f64;
        [index as f64 * dt, run.torques[first + index], mean, epistemic_uncertainty(&means, &variances)]
    };
    rows.iter().enumerate().map(row).collect()
}

/// A line a cell.
fn numbers(cells: &[Vec<Cell>], names: &[&str]) -> String {
    let mut text = "learnt_from,judged_by,torque_rmse_nm,euf_nat,euf_95_percent_nat\n".to_owned();
    for (row, name) in cells.iter().zip(names) {
        for (Cell { rmse, mean_uncertainty: euf, uncertainty_p95: high_euf, .. }, judge) in row.iter().zip(names) {
            let _ = writeln!(text, "{name},{judge},{rmse:.4},{euf:.4},{high_euf:.4}");
        }
    }
    text
}

/// A row an ensemble, a column a stage that judges it.
fn picture(cells: &[Vec<Cell>], names: &[&str]) -> Result<String, PlotError> {
    let count = names.len();
    let size = (CELL.0 * count as u32, CELL.1 * count as u32 + 40);
    let all = || cells.iter().flatten().flat_map(|cell| &cell.drawn);
    let most_euf = all().map(|row| row[3]).fold(0.1, f64::max);
    chart::picture(size, |root| {
        let (head, grid) = root.split_vertically(80);
        chart::legend(
            &head,
            &[("measured", INK), ("ensemble's mean", ORANGE), ("disagreement", GREY)],
            600,
            (160, 44),
        )?;
        for (place, area) in grid.split_evenly((count, count)).iter().enumerate() {
            let (row, column) = (place / count, place % count);
            let cell = &cells[row][column];
            let of = |value: usize| cell.drawn.iter().map(|row| (row[0], row[value])).collect::<Vec<_>>();
            // One scale a column: it is one stretch of one log.
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
                caption: format!("mean disagreement {:.3} nat", cell.mean_uncertainty),
                x_label: "",
                y_label: "[nat]",
                x: 0.0..end,
                y: 0.0..most_euf,
                lines: vec![Line { colour: GREY, width: 4, pieces: vec![of(3)] }],
            }
            .draw(&below)?;
        }
        Ok(())
    })
}

/// The last part of a path.
fn short(name: &str) -> &str {
    Path::new(name).file_stem().and_then(|stem| stem.to_str()).unwrap_or(name)
}
