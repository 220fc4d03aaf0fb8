//! Registers of single-precision numbers, one a joint, for the networks in the loop.
//!
//! Lanes never meet, multiplications and additions are fused on every processor, and all operations round as IEEE 754 says:
//! a joint's bits are the same in any register. [`twinstep_model::lanes`] never fuses, because processors without such an
//! instruction are slow at it; a network is little else than multiplying and adding, and takes half the time so.

#![allow(clippy::inline_always, reason = "what stays out of line is compiled for the oldest processor")]

/// Several numbers side by side.
pub trait Wide: Copy + Send + Sync + 'static {
    /// How many.
    const LANES: usize;

    /// The same number in every lane.
    fn splat(value: f32) -> Self;
    fn get(&self, lane: usize) -> f32;
    fn set(&mut self, lane: usize, value: f32);
    fn plus(self, other: Self) -> Self;
    fn minus(self, other: Self) -> Self;
    fn times(self, other: Self) -> Self;
    fn over(self, other: Self) -> Self;
    /// `self · factor + summand`, rounded once.
    fn fused(self, factor: Self, summand: Self) -> Self;
    fn sqrt(self) -> Self;
    /// The larger; `other` where either is not a number.
    fn max(self, other: Self) -> Self;
    /// The smaller; `other` where either is not a number.
    fn min(self, other: Self) -> Self;
    /// Two to the power of a whole number from −126 to 127.
    fn power_of_two(self) -> Self;
    /// `then` where `self` is greater than zero, else `otherwise`.
    fn select_positive(self, then: Self, otherwise: Self) -> Self;
}

/// Four numbers on any processor.
#[derive(Clone, Copy)]
#[repr(align(16))]
pub struct Portable([f32; 4]);

impl Portable {
    #[inline(always)]
    fn with(self, other: Self, operation: impl Fn(f32, f32) -> f32) -> Self {
        Self(std::array::from_fn(|lane| operation(self.0[lane], other.0[lane])))
    }
}

impl Wide for Portable {
    const LANES: usize = 4;

    fn splat(value: f32) -> Self {
        Self([value; 4])
    }
    fn get(&self, lane: usize) -> f32 {
        self.0[lane]
    }
    fn set(&mut self, lane: usize, value: f32) {
        self.0[lane] = value;
    }
    fn plus(self, other: Self) -> Self {
        self.with(other, |a, b| a + b)
    }
    fn minus(self, other: Self) -> Self {
        self.with(other, |a, b| a - b)
    }
    fn times(self, other: Self) -> Self {
        self.with(other, |a, b| a * b)
    }
    fn over(self, other: Self) -> Self {
        self.with(other, |a, b| a / b)
    }
    fn fused(self, factor: Self, summand: Self) -> Self {
        Self(std::array::from_fn(|lane| self.0[lane].mul_add(factor.0[lane], summand.0[lane])))
    }
    fn sqrt(self) -> Self {
        Self(self.0.map(f32::sqrt))
    }
    fn max(self, other: Self) -> Self {
        self.with(other, |a, b| if a > b { a } else { b })
    }
    fn min(self, other: Self) -> Self {
        self.with(other, |a, b| if a < b { a } else { b })
    }
    fn power_of_two(self) -> Self {
        Self(self.0.map(|power| f32::from_bits(((power as i32 + 127) as u32) << 23)))
    }
    fn select_positive(self, then: Self, otherwise: Self) -> Self {
        Self(std::array::from_fn(|lane| if self.0[lane] > 0.0 { then.0[lane] } else { otherwise.0[lane] }))
    }
}

#[cfg(target_arch = "x86_64")]
pub use x86::{Avx2, Avx512};

/// A value of these types may only be made where the processor has the instructions, and the code that works on it
/// belongs below one function with the matching `#[target_feature]`.
#[cfg(target_arch = "x86_64")]
mod x86 {
    #![allow(unsafe_code, reason = "the intrinsics want the instruction set, which whoever makes a value has checked")]

    #[allow(clippy::wildcard_imports, reason = "the names say where they are from")]
    use std::arch::x86_64::*;

    use super::Wide;

    macro_rules! register {
        (
            $(#[$doc:meta])*
            $name:ident($raw:ty): $lanes:literal,
            $splat:ident, $plus:ident, $minus:ident, $times:ident, $over:ident, $fused:ident, $sqrt:ident, $max:ident,
            $min:ident,
            |$power:ident| $power_of_two:expr,
            |$value:ident, $then:ident, $otherwise:ident| $select:expr
        ) => {
            $(#[$doc])*
            #[derive(Clone, Copy)]
            #[repr(transparent)]
            pub struct $name($raw);

            impl Wide for $name {
                const LANES: usize = $lanes;

                #[inline(always)]
                fn splat(value: f32) -> Self {
                    Self(unsafe { $splat(value) })
                }
                #[inline(always)]
                fn get(&self, lane: usize) -> f32 {
                    // SAFETY: a register is its lanes, one after the other.
                    let values: &[f32; $lanes] = unsafe { &*(&raw const self.0).cast() };
                    values[lane]
                }
                #[inline(always)]
                fn set(&mut self, lane: usize, value: f32) {
                    // SAFETY: a register is its lanes, one after the other, and any bits are a number.
                    let values: &mut [f32; $lanes] = unsafe { &mut *(&raw mut self.0).cast() };
                    values[lane] = value;
                }
                #[inline(always)]
                fn plus(self, other: Self) -> Self {
                    Self(unsafe { $plus(self.0, other.0) })
                }
                #[inline(always)]
                fn minus(self, other: Self) -> Self {
                    Self(unsafe { $minus(self.0, other.0) })
                }
                #[inline(always)]
                fn times(self, other: Self) -> Self {
                    Self(unsafe { $times(self.0, other.0) })
                }
                #[inline(always)]
                fn over(self, other: Self) -> Self {
                    Self(unsafe { $over(self.0, other.0) })
                }
                #[inline(always)]
                fn fused(self, factor: Self, summand: Self) -> Self {
                    Self(unsafe { $fused(self.0, factor.0, summand.0) })
                }
                #[inline(always)]
                fn sqrt(self) -> Self {
                    Self(unsafe { $sqrt(self.0) })
                }
                #[inline(always)]
                fn max(self, other: Self) -> Self {
                    Self(unsafe { $max(self.0, other.0) })
                }
                #[inline(always)]
                fn min(self, other: Self) -> Self {
                    Self(unsafe { $min(self.0, other.0) })
                }
                #[inline(always)]
                fn power_of_two(self) -> Self {
                    let $power = self.0;
                    Self(unsafe { $power_of_two })
                }
                #[inline(always)]
                fn select_positive(self, then: Self, otherwise: Self) -> Self {
                    let ($value, $then, $otherwise) = (self.0, then.0, otherwise.0);
                    Self(unsafe { $select })
                }
            }
        };
    }

    register! {
        /// Sixteen numbers in a register of AVX-512.
        Avx512(__m512): 16,
        _mm512_set1_ps, _mm512_add_ps, _mm512_sub_ps, _mm512_mul_ps, _mm512_div_ps, _mm512_fmadd_ps, _mm512_sqrt_ps,
        _mm512_max_ps, _mm512_min_ps,
        |power| _mm512_castsi512_ps(_mm512_slli_epi32::<23>(_mm512_add_epi32(
            _mm512_cvtps_epi32(power), _mm512_set1_epi32(127)))),
        |value, then, otherwise| _mm512_mask_blend_ps(
            _mm512_cmp_ps_mask::<_CMP_GT_OQ>(value, _mm512_setzero_ps()), otherwise, then)
    }

    register! {
        /// Eight numbers in a register of AVX2.
        Avx2(__m256): 8,
        _mm256_set1_ps, _mm256_add_ps, _mm256_sub_ps, _mm256_mul_ps, _mm256_div_ps, _mm256_fmadd_ps, _mm256_sqrt_ps,
        _mm256_max_ps, _mm256_min_ps,
        |power| _mm256_castsi256_ps(_mm256_slli_epi32::<23>(_mm256_add_epi32(
            _mm256_cvtps_epi32(power), _mm256_set1_epi32(127)))),
        |value, then, otherwise| _mm256_blendv_ps(
            otherwise, then, _mm256_cmp_ps::<_CMP_GT_OQ>(value, _mm256_setzero_ps()))
    }
}
