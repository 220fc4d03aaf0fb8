//! Table and learning curves of a fitted ensemble.

use twinstep_ensemble::{Calibration, Coverage, Epoch};
use twinstep_report::chart::{self, GREY, HPos, Line, ORANGE, Panel, PlotError};

/// Width and height of the plot of the learning curves [px].
const SIZE: (u32, u32) = (900, 600);

/// Returns a table with two lines per member and for their mixture: before and after scaling the variances.
pub fn table(found: &Calibration, variance_scale: f64) -> String {
    let mut lines = vec![
        format!("evaluated on {} held-out rows", found.rows),
        format!("torque RMSE of the members' mean: {:.4} N·m", found.rmse),
        format!("mean standard deviation: {:.4} N·m, all variances scaled by {variance_scale:.3}", found.sharpness),
        format!(
            "{:<22}{:>7}{:>7}{:>7}  {:>12}  {:>8}",
            "intervals cover", "50 %", "90 %", "95 %", "PIT distance", "NLL"
        ),
    ];
    let names = (1..=found.members.len()).map(|number| format!("member {number}")).chain(["mixture".to_owned()]);
    for (name, [before, after]) in names.zip(found.members.iter().chain([&found.mixture])) {
        lines.push(line(&name, before));
        lines.push(line(&format!("{name}, scaled"), after));
    }
    lines.join("\n") + "\n"
}

fn line(name: &str, coverage: &Coverage) -> String {
    let [half, ninety, more] = coverage.empirical.map(|share| 100.0 * share);
    let Coverage { pit_ks_statistic: pit_distance, nll, .. } = coverage;
    format!("{name:<22}{half:>7.1}{ninety:>7.1}{more:>7.1}  {pit_distance:>12.3}  {nll:>8.3}")
}

/// Plots the negative log-likelihood of every member over its epochs.
pub fn curves_svg(curves: &[Vec<Epoch>]) -> Result<String, PlotError> {
    let of = |value: fn(&Epoch) -> f64| {
        let points = move |curve: &Vec<Epoch>| {
            curve.iter().enumerate().map(|(index, epoch)| ((index + 1) as f64, value(epoch))).collect::<Vec<_>>()
        };
        curves.iter().map(points).collect::<Vec<_>>()
    };
    let (training, validation) = (of(|epoch| epoch.training_nll), of(|epoch| epoch.validation_nll));
    let longest = curves.iter().map(Vec::len).max().unwrap_or(1).max(2);
    let values = training.iter().chain(&validation).flatten().map(|(_, nll)| *nll);
    let panel = Panel {
        caption: format!("Training of {} networks", curves.len()),
        x_label: "epoch",
        y_label: "negative log-likelihood [nat]",
        x: 1.0..longest as f64,
        y: chart::range(values),
        lines: vec![
            Line { colour: GREY, width: 3, pieces: training.clone() },
            Line { colour: ORANGE, width: 3, pieces: validation.clone() },
        ],
    };
    chart::picture(SIZE, |root| {
        panel.draw(root)?;
        let names = [("training", GREY), ("validation", ORANGE)];
        chart::legend(root, &names, 420, (900, 120))?;
        chart::text(root, "each line is one network", 34, HPos::Left, (900, 180))
    })
}
