//! Registers of floating-point numbers, with the instruction set chosen at run time.
//!
//! - [`SimdFloat`]: one number in each lane of a register. The physics engine puts one robot in a lane, the actuator
//!   networks one joint.
//! - [`InstructionSet`]: a proof that the processor has an instruction set. It cannot be made without asking the
//!   processor. The environment variable `TWINSTEP_SIMD` selects one: `portable`, `sse2`, `avx2` or `avx512`.
//! - [`SimdTask`], [`with_f32`], [`with_f64`]: run generic code with the register type of an instruction set. The
//!   register types of x86-64 have no public name, so no value of them exists without that proof.
//! - [`SimdKernel`], [`SimdFloat::vectorise`]: compile an inner loop for the instruction set.
//!
//! `f64` and [`F32x4`] run on every processor and are public.
//!
//! Every lane is computed on its own: its bits depend neither on its neighbours nor on the register's width. All
//! operations round as IEEE 754 says, so every instruction set gives the same bits.

#![allow(clippy::inline_always, reason = "a function that is not inlined is compiled for the oldest processor")]
#![allow(clippy::needless_range_loop, reason = "indices of lanes and coefficients read as in the textbook")]

mod dispatch;
mod float;
mod functions;
mod instruction_set;
mod portable;
#[cfg(target_arch = "x86_64")]
mod x86;

pub use dispatch::{SimdTask, with_f32, with_f64};
pub use float::{SimdFloat, SimdKernel};
pub use functions::exponential;
pub use instruction_set::{InstructionSet, UnknownInstructionSet};
pub use portable::F32x4;
