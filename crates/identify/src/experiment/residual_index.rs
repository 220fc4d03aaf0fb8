//! Index of the residuals: channel and row, window, group and block of each one.

use super::Experiment;
use super::channel::{Channel, ResidualChannel};
use crate::window::Window;

/// Number of values of [`Regime`].
const REGIMES: usize = 3;

/// How the base moves in a window.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Regime {
    /// A floating base that stands or moves slowly.
    Floating,
    /// A fixed base.
    Fixed,
    /// A floating base that walks, trots or jumps.
    Dynamic,
}

impl Experiment {
    /// Returns the channel and row of every residual.
    pub fn residual_index(&self) -> impl Iterator<Item = (ResidualChannel, usize)> {
        let windows = self.channels.iter().flat_map(|channel| self.windows.iter().map(move |window| (channel, window)));
        windows.flat_map(|(channel, window)| channel.rows(window).map(move |(_, row)| (channel.quantity, row)))
    }

    /// Returns the indices of the residuals of every window with a floating base.
    pub fn free_windows(&self) -> Vec<Vec<usize>> {
        let mut of_window = vec![Vec::new(); self.windows.len()];
        let mut next = 0;
        for channel in &self.channels {
            for (window, own) in self.windows.iter().zip(&mut of_window) {
                let count = channel.rows(window).count();
                own.extend(next..next + count);
                next += count;
            }
        }
        let pairs = self.windows.iter().zip(of_window);
        pairs.filter(|(window, own)| !window.base.is_fixed() && !own.is_empty()).map(|(_, own)| own).collect()
    }

    /// Returns for every residual whether it has the errors of contact: the robot walks, trots or jumps in a window that is
    /// marked as such, and the residual is not a torque on measured states.
    pub fn dynamic_residuals(&self) -> Vec<bool> {
        let is_dynamic = |channel: &Channel, window: &Window| window.dynamic && channel.torque_joint(window).is_none();
        let windows = self.channels.iter().flat_map(|channel| self.windows.iter().map(move |window| (channel, window)));
        let same = windows.flat_map(|(channel, window)| channel.rows(window).map(move |_| is_dynamic(channel, window)));
        same.collect()
    }

    /// Upper bound of the values of [`Experiment::groups`].
    pub const GROUPS: usize = 9 * REGIMES;

    /// Returns the regime of a group.
    pub fn regime(group: usize) -> Regime {
        [Regime::Floating, Regime::Fixed, Regime::Dynamic][group % REGIMES]
    }

    /// Returns the group of every residual: a number for its quantity and its [`Regime`].
    pub fn groups(&self) -> Vec<usize> {
        let group = |channel: &Channel, window: &Window| {
            let quantity = match channel.quantity {
                ResidualChannel::Position(_) => 0,
                ResidualChannel::Velocity(_) => 1,
                ResidualChannel::Torque(_) => 2,
                ResidualChannel::BasePosition(_) => 3,
                ResidualChannel::BaseOrientation(_) => 4,
                ResidualChannel::BaseVelocity(_) => 5,
                ResidualChannel::BaseRate(_) => 6,
                ResidualChannel::BaseWrench(0..3) => 7,
                ResidualChannel::BaseWrench(_) => 8,
            };
            let regime = match (window.base.is_fixed(), window.dynamic) {
                (true, _) => Regime::Fixed,
                (false, false) => Regime::Floating,
                (false, true) => Regime::Dynamic,
            };
            REGIMES * quantity + regime as usize
        };
        let windows = self.channels.iter().flat_map(|channel| self.windows.iter().map(move |window| (channel, window)));
        let same = windows.flat_map(|(channel, window)| channel.rows(window).map(move |_| group(channel, window)));
        same.collect()
    }

    /// Returns the block of every residual: half a second, or a window with a floating base.
    pub fn blocks(&self) -> Vec<usize> {
        let windows = self.channels.iter().flat_map(|channel| self.windows.iter().map(move |window| (channel, window)));
        let block = |window: &Window, row: usize| {
            // An error of the initial state persists through a whole window with a floating base.
            (if window.base.is_fixed() { row } else { window.rows.start }) / self.rows_per_block
        };
        windows.flat_map(|(channel, window)| channel.rows(window).map(move |(_, row)| block(window, row))).collect()
    }
}
