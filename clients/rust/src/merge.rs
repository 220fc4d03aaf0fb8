//! Rows of several leases in one batch.

use twinstep_model::StepBatch;

/// Copies a step of the rows from `first` on into the batch of all environments.
pub fn merge(all: &mut StepBatch, part: &StepBatch, first: usize) {
    let num_envs = part.reward.len();
    copy_rows(&mut all.obs, first, &part.obs, num_envs);
    copy_rows(&mut all.critic_obs, first, &part.critic_obs, num_envs);
    copy_rows(&mut all.reward, first, &part.reward, num_envs);
    copy_rows(&mut all.terminated, first, &part.terminated, num_envs);
    copy_rows(&mut all.truncated, first, &part.truncated, num_envs);
    all.ended.extend(part.ended.iter().cloned().map(|mut episode| {
        episode.env += first;
        episode
    }));
}

/// Copies `num_envs` rows to the rows from `first` on.
pub fn copy_rows<T: Copy>(all: &mut [T], first: usize, rows: &[T], num_envs: usize) {
    let length = rows.len() / num_envs;
    all[first * length..(first + num_envs) * length].copy_from_slice(rows);
}
