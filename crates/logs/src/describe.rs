//! Summary of a log: size, timing, contents and motion of the joints.

use twinstep_model::Joint;

use crate::columns::{Column, MissingCells, QUANTITIES, Quantity};
use crate::excitation::excitation;
use crate::falls::falls;
use crate::identifiability::conclusions;
use crate::missing_channels::absent;
use crate::statistics::{largest, quantile, quantum, standard_deviation};
use crate::summary::{ChannelDescription, LogSummary, MissingChannel, SegmentDescription, Timing};
use crate::{Log, TorqueSensor};

impl Log {
    /// Returns the summary of the log.
    pub fn describe(&self) -> LogSummary {
        let timing = self.timing();
        let mut description = LogSummary {
            rows: self.rows(),
            duration_s: self.duration_s(),
            segments: self.described_segments(),
            channels: self.described_channels(),
            absent: absent(self)
                .into_iter()
                .map(|(quantity, cost)| MissingChannel { quantity, consequence: cost })
                .collect(),
            joints: self.joints().iter().filter_map(|joint| excitation(self, joint)).collect(),
            falls: falls(self),
            conclusions: Vec::new(),
            ignored: self.ignored().to_vec(),
            problems: self.problems(),
            warnings: self.notes(&timing),
            timing,
        };
        description.conclusions = conclusions(self, &description);
        description
    }

    fn timing(&self) -> Timing {
        const GAP: f64 = 1.5;
        let mut steps: Vec<f64> = self.differences(self.t()).map(|(_, step)| step).collect();
        steps.sort_by(f64::total_cmp);
        let median = quantile(&steps, 0.5);
        let mut jitter: Vec<f64> = steps.iter().map(|step| (step - median.unwrap_or(0.0)).abs()).collect();
        jitter.sort_by(f64::total_cmp);
        let gaps = steps.iter().filter(|step| median.is_some_and(|median| **step > GAP * median)).count();
        Timing {
            stated_rate_hz: self.meta().rate_hz,
            rate_hz: median.map(f64::recip),
            step_std_s: median.map(|_| standard_deviation(&steps)),
            jitter_p50_s: quantile(&jitter, 0.5),
            jitter_p99_s: quantile(&jitter, 0.99),
            jitter_max_s: jitter.last().copied(),
            gaps,
            largest_gap_s: steps.last().copied().filter(|_| gaps > 0),
        }
    }

    fn described_segments(&self) -> Vec<SegmentDescription> {
        let mut described: Vec<_> = (self.meta().segments.iter())
            .map(|segment| {
                let (name, base) = (segment.name.clone(), segment.base);
                SegmentDescription { name, base, parts: 0, rows: 0, duration_s: 0.0 }
            })
            .collect();
        for (_, rows) in self.segments() {
            let segment = &mut described[self.segment()[rows.start] as usize];
            segment.parts += 1;
            segment.rows += rows.len();
            segment.duration_s += self.t()[rows.end - 1] - self.t()[rows.start];
        }
        described.retain(|segment| segment.rows > 0);
        described
    }

    fn described_channels(&self) -> Vec<ChannelDescription> {
        let described = |quantity: &'static Quantity| {
            let cells: Vec<_> = self
                .channels()
                .filter(|(name, _)| Column::parse(name).is_some_and(|column| column.quantity == quantity))
                .map(|(_, cells)| cells)
                .collect();
            (!cells.is_empty()).then(|| ChannelDescription {
                quantity: quantity.name,
                unit: quantity.unit,
                columns: cells.len(),
                quantum: (quantity.cells == MissingCells::Allowed || quantity.name == "q")
                    .then(|| largest(cells.iter().filter_map(|cells| quantum(cells))))
                    .flatten(),
                missing_cells: cells.iter().copied().flatten().filter(|cell| cell.is_nan()).count(),
            })
        };
        QUANTITIES.iter().filter_map(described).collect()
    }

    fn notes(&self, timing: &Timing) -> Vec<String> {
        const TOLERANCE: f64 = 0.05;
        // Beyond the joint ranges of the Go2 [rad]; positions in degrees exceed it.
        const MAX_POSITION: f64 = 7.0;
        let mut notes = self.read_warnings().to_vec();
        if let Some(rate) = timing.rate_hz
            && (rate / timing.stated_rate_hz - 1.0).abs() > TOLERANCE
        {
            notes.push(format!(
                "the measured rate is {rate:.1} Hz, but `rate_hz` of the meta file is {} Hz",
                timing.stated_rate_hz
            ));
        }
        let torque = self.joints().iter().any(|joint| self.tau_measured(joint).is_some());
        if torque && self.meta().tau_sensor == TorqueSensor::None {
            notes.push("tau_measured is not compared, because `tau_sensor` of the meta file is \"none\"".to_owned());
        }
        if !torque && self.meta().tau_sensor != TorqueSensor::None {
            notes.push("the meta file has a `tau_sensor`, but the log has no tau_measured".to_owned());
        }
        for quantity in ["q", "q_cmd"] {
            let far = |joint: &&Joint| {
                let cells = self.channel(&format!("{quantity}_{joint}"));
                cells.is_some_and(|cells| cells.iter().any(|cell| cell.abs() > MAX_POSITION))
            };
            if let Some(joint) = Joint::ALL.iter().find(far) {
                notes.push(format!(
                    "{quantity}_{joint} exceeds {MAX_POSITION} rad in magnitude: positions must be in radians, not \
                     degrees"
                ));
            }
        }
        notes
    }

    /// Returns each row with the difference of a channel to the next row, within contiguous ranges of rows.
    fn differences(&self, channel: &[f64]) -> impl Iterator<Item = (usize, f64)> {
        self.segments().flat_map(|(_, rows)| rows.start..rows.end - 1).map(|row| (row, channel[row + 1] - channel[row]))
    }
}
