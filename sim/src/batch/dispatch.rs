//! One source, several instruction sets: the widest that the processor has is chosen at run time.

use super::group::Group;
use super::lane::F32x8;

/// Advances a group by `steps` physics steps.
pub fn step(group: &mut Group<F32x8>, tau: &[F32x8; 12], steps: usize) {
    #[cfg(target_arch = "x86_64")]
    if is_x86_feature_detected!("avx2") {
        // SAFETY: the processor has AVX2.
        #[allow(unsafe_code)]
        unsafe {
            step_avx2(group, tau, steps);
        }
        return;
    }
    group.step(tau, steps);
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn step_avx2(group: &mut Group<F32x8>, tau: &[F32x8; 12], steps: usize) {
    group.step(tau, steps);
}
