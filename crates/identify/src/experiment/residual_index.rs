//! Index of the residuals: channel and row, window, group and block of each one.

use super::Experiment;
use super::channel::{Channel, ResidualChannel};
use crate::window::Window;

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

    /// Upper bound of the values of [`Experiment::groups`].
    pub const GROUPS: usize = 14;

    /// Returns true if a group has a fixed base.
    pub fn is_held(group: usize) -> bool {
        group % 2 == 1
    }

    /// Returns the group of every residual: a number for its quantity and the mount of the base.
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
            };
            2 * quantity + usize::from(window.base.is_fixed())
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
