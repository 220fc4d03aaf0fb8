//! From an instruction set to the code that runs on its registers.

use crate::float::SimdFloat;
use crate::instruction_set::{InstructionSet, Level};
use crate::portable::F32x4;
#[cfg(target_arch = "x86_64")]
use crate::x86::{Avx2F32, Avx2F64, Avx512F32, Avx512F64, Sse2F32};

/// Code that is generic over the register type.
pub trait SimdTask {
    /// The result.
    type Output;

    /// Runs on registers of type `T`.
    fn run<T: SimdFloat>(self) -> Self::Output;
}

/// Runs `task` on single-precision registers of an instruction set.
pub fn with_f32<K: SimdTask>(instructions: InstructionSet, task: K) -> K::Output {
    match instructions.0 {
        #[cfg(target_arch = "x86_64")]
        Level::Avx512 => task.run::<Avx512F32>(),
        #[cfg(target_arch = "x86_64")]
        Level::Avx2 => task.run::<Avx2F32>(),
        #[cfg(target_arch = "x86_64")]
        Level::Sse2 => task.run::<Sse2F32>(),
        Level::Portable => task.run::<F32x4>(),
    }
}

/// Runs `task` on double-precision registers of an instruction set: eight lanes of AVX-512, four of AVX2, one lane otherwise.
pub fn with_f64<K: SimdTask>(instructions: InstructionSet, task: K) -> K::Output {
    match instructions.0 {
        #[cfg(target_arch = "x86_64")]
        Level::Avx512 => task.run::<Avx512F64>(),
        #[cfg(target_arch = "x86_64")]
        Level::Avx2 => task.run::<Avx2F64>(),
        #[cfg(target_arch = "x86_64")]
        Level::Sse2 => task.run::<f64>(),
        Level::Portable => task.run::<f64>(),
    }
}
