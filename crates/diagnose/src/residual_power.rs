//! Residual power of each channel, in units of the variance of noise and model error.

use std::ops::Range;

use twinstep_effects::Target;
use twinstep_model::NUM_JOINTS;

/// Number of channels: joint positions with a fixed base, torques, base position, orientation, velocity and angular
/// velocity, joint positions with a floating base, force and moment on the base of a standing robot, and joint positions
/// and base motion of a robot that walks or jumps.
///
/// Positions with a floating base are channels of their own, because they have the errors of the contact model, too. A
/// robot that walks or jumps shows little else: its channels are evidence only about the ground.
pub const CHANNELS: usize = DYNAMIC + NUM_JOINTS + 12;
/// First channel of the torques.
pub const TORQUE: usize = NUM_JOINTS;
/// First channel of the base.
pub const TRUNK: usize = 2 * NUM_JOINTS;
/// First channel of the gyroscope.
pub const GYRO: usize = TRUNK + 9;
/// First channel of the joint positions with a floating base.
pub const STANCE: usize = TRUNK + 12;
/// First channel of force and moment on the base of a standing robot.
pub const WRENCH: usize = STANCE + NUM_JOINTS;
/// First channel of the gyroscope with a fixed base, where it reads its bias.
pub const GYRO_AT_REST: usize = WRENCH + 6;
/// First channel of a robot that walks or jumps: joint positions, then base position, orientation, velocity and angular
/// velocity.
pub const DYNAMIC: usize = GYRO_AT_REST + 3;

/// Returns the channels that are evidence about effects on these targets.
pub fn evident_channels(targets: impl IntoIterator<Item = Target>) -> Range<usize> {
    let on_ground = targets.into_iter().any(|target| target == Target::Ground);
    0..if on_ground { CHANNELS } else { DYNAMIC }
}

/// Sums of squared residuals and numbers of rows by channel and fold, in units of the variance of noise and model
/// error.
#[derive(Clone, Debug)]
pub struct ResidualPower {
    /// Sums of squared residuals.
    pub sums: [[f64; 2]; CHANNELS],
    /// Numbers of rows.
    pub counts: [[f64; 2]; CHANNELS],
    /// Penalties of the nuisance parameters of initial states and of the robot [nat].
    pub nuisance_cost: [f64; 2],
}

impl ResidualPower {
    /// Returns zero sums and counts.
    pub fn empty() -> Self {
        Self { sums: [[0.0; 2]; CHANNELS], counts: [[0.0; 2]; CHANNELS], nuisance_cost: [0.0; 2] }
    }

    /// Returns the decrease of the penalties of nuisance parameters from `before` [nat].
    ///
    /// Penalties are divided by the residual power if that exceeds noise, because the nuisance parameters are then less
    /// certain.
    pub fn tolerated_gain(&self, before: &Self) -> f64 {
        let cost = |left: &Self| left.nuisance_cost.iter().sum::<f64>() / left.power().max(1.0);
        cost(before) - cost(self)
    }

    /// Returns the mean power of all rows, in units of the variance of noise and model error.
    fn power(&self) -> f64 {
        let [sums, counts] = [&self.sums, &self.counts].map(|all| all[..DYNAMIC].iter().flatten().sum::<f64>());
        sums / counts.max(1.0)
    }

    /// Adds the normalised residual of a row in a fold. `None` is a held-out block, which is not added.
    pub fn add(&mut self, channel: usize, fold: Option<usize>, difference: f64) {
        let Some(fold) = fold else { return };
        self.sums[channel][fold] += difference * difference;
        self.counts[channel][fold] += 1.0;
    }

    /// Adds the sums and counts of `other`.
    pub fn add_all(&mut self, other: &Self) {
        let mine = self.sums.as_flattened_mut().iter_mut().chain(self.counts.as_flattened_mut());
        mine.zip(other.sums.as_flattened().iter().chain(other.counts.as_flattened()))
            .for_each(|(sum, more)| *sum += more);
    }

    /// Returns true if the simulation diverged.
    pub fn diverged(&self) -> bool {
        self.sums.iter().flatten().any(|sum| !sum.is_finite())
    }

    /// Returns the log-likelihood gain over `before` for one channel and fold [nat].
    ///
    /// ½ n ln(SSR_before / SSR), with n = row count / `rows`, where `rows` is the correlation length.
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

    /// Returns true if a torque or a position with a fixed base has more than `least` times the power of noise above it.
    pub fn shows_missing_torque(&self, least: f64) -> bool {
        let count = |channel: usize| self.counts[channel].iter().sum::<f64>();
        (0..TRUNK).any(|channel| self.channel_excess(channel) > least * count(channel))
    }

    /// Returns the power above noise and model error of a channel.
    fn channel_excess(&self, channel: usize) -> f64 {
        let sum: f64 = self.sums[channel].iter().sum();
        (sum - self.counts[channel].iter().sum::<f64>()).max(0.0)
    }
}
