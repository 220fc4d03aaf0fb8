//! What a candidate leaves of each channel, in units of noise and of the misfit of any simulator.

use twinstep_model::NUM_JOINTS;

use twinstep_identify::nuisance;

/// Channels: positions, torques, and of the trunk position, orientation, velocity and rate.
pub const CHANNELS: usize = 2 * NUM_JOINTS + 12;
/// First channel of the torques.
pub const TORQUE: usize = NUM_JOINTS;
/// First channel of the trunk.
pub const TRUNK: usize = 2 * NUM_JOINTS;
/// First channel of its gyroscope.
pub const GYRO: usize = TRUNK + 9;

/// Sums of squares and counts by channel and fold, in units of noise and misfit.
#[derive(Clone, Debug)]
pub struct ResidualPower {
    /// Sums of squares.
    pub sums: [[f64; 2]; CHANNELS],
    /// Numbers of rows.
    pub counts: [[f64; 2]; CHANNELS],
    /// What tolerated errors cost that explain a part of the rest, of starts and of the robot [nats].
    pub nuisance_cost: [f64; 2],
}

impl ResidualPower {
    /// Nothing yet.
    pub fn empty() -> Self {
        Self { sums: [[0.0; 2]; CHANNELS], counts: [[0.0; 2]; CHANNELS], nuisance_cost: [0.0; 2] }
    }

    /// How much less tolerated errors cost than `before` [nats]. Where more than noise is left, the errors that explain a part
    /// of it are as uncertain.
    pub fn tolerated_gain(&self, before: &Self) -> f64 {
        let cost = |left: &Self| left.nuisance_cost.iter().sum::<f64>() / left.power().max(1.0);
        cost(before) - cost(self)
    }

    /// Mean power of all rows, in units of noise and misfit.
    fn power(&self) -> f64 {
        self.sums.iter().flatten().sum::<f64>() / self.counts.iter().flatten().sum::<f64>().max(1.0)
    }

    /// Adds a difference, in units of noise and misfit, of a row in a fold; none is set aside.
    pub fn add(&mut self, channel: usize, fold: Option<usize>, difference: f64) {
        let Some(fold) = fold else { return };
        self.sums[channel][fold] += difference * difference;
        self.counts[channel][fold] += 1.0;
    }

    /// Adds what is left of other rows.
    pub fn add_all(&mut self, other: &Self) {
        let mine = self.sums.as_flattened_mut().iter_mut().chain(self.counts.as_flattened_mut());
        mine.zip(other.sums.as_flattened().iter().chain(other.counts.as_flattened()))
            .for_each(|(sum, more)| *sum += more);
    }

    /// True if the candidate diverged.
    pub fn diverged(&self) -> bool {
        self.sums.iter().flatten().any(|sum| !sum.is_finite())
    }

    /// Evidence for this model against `before` in a channel and fold [nats], with `rows` counting as one.
    pub fn log_likelihood_gain(&self, before: &Self, channel: usize, fold: usize, rows: f64) -> f64 {
        let (now, then, count) = (self.sums[channel][fold], before.sums[channel][fold], before.counts[channel][fold]);
        if count == 0.0 {
            return 0.0;
        }
        if !now.is_finite() {
            return f64::NEG_INFINITY;
        }
        0.5 * count / rows * ((then + 1e-9) / (now + 1e-9)).ln()
    }

    /// Power above noise and misfit, everywhere.
    pub fn power_above_noise(&self) -> f64 {
        (0..CHANNELS).map(|channel| self.channel_excess(channel)).sum::<f64>() + self.tolerated_excess()
    }

    /// Power that errors of the robot would have to explain beyond what any robot has.
    pub fn tolerated_excess(&self) -> f64 {
        nuisance::excess(self.nuisance_cost[1])
    }

    /// Power above noise and misfit of a channel.
    pub fn channel_excess(&self, channel: usize) -> f64 {
        let sum: f64 = self.sums[channel].iter().sum();
        (sum - self.counts[channel].iter().sum::<f64>()).max(0.0)
    }
}
