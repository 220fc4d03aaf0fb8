//! Registers of x86-64 processors.
//!
//! These types are private to the crate. Code outside meets them as a type parameter in [`crate::SimdTask::run`] only,
//! which [`crate::with_f32`] and [`crate::with_f64`] call with an [`crate::InstructionSet`] that the processor has.

#![allow(unsafe_code, reason = "an `InstructionSet` proves that the processor has the instructions")]

#[allow(clippy::wildcard_imports, reason = "the names say where they are from")]
use std::arch::x86_64::*;

use crate::float::{SimdFloat, SimdKernel, operators};
use crate::functions::{sin_cos_double, sin_cos_single};

/// Defines a lane type over one register.
macro_rules! register {
    (
        $(#[$doc:meta])*
        $name:ident($raw:ty): $lanes:literal of $scalar:ty, $feature:literal, $sin_cos:ident,
        $splat:ident, $plus:ident, $minus:ident, $times:ident, $over:ident, $sqrt:ident, $max:ident, $min:ident,
        |$from:ident| $negated:expr,
        |$factor:ident, $other:ident, $summand:ident| $mul_add:expr,
        |$power:ident| $exp2_integer:expr,
        |$value:ident, $limit:ident, $then:ident, $otherwise:ident| $select:expr,
        any $any:expr
    ) => {
        $(#[$doc])*
        #[derive(Clone, Copy, Debug)]
        #[repr(transparent)]
        pub(crate) struct $name($raw);

        operators!($name);

        impl $name {
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
            fn negated(self) -> Self {
                let $from = self.0;
                Self(unsafe { $negated })
            }
        }

        impl SimdFloat for $name {
            const LANES: usize = $lanes;

            #[inline(always)]
            fn splat(value: f64) -> Self {
                Self(unsafe { $splat(value as $scalar) })
            }

            #[inline(always)]
            fn get(&self, lane: usize) -> f64 {
                // SAFETY: a register is its lanes, one after the other.
                let values: &[$scalar; $lanes] = unsafe { &*(&raw const self.0).cast() };
                f64::from(values[lane])
            }

            #[inline(always)]
            fn set(&mut self, lane: usize, value: f64) {
                // SAFETY: a register is its lanes, one after the other, and any bits are a number.
                let values: &mut [$scalar; $lanes] = unsafe { &mut *(&raw mut self.0).cast() };
                values[lane] = value as $scalar;
            }

            #[inline(always)]
            fn load(values: &[f32]) -> Self {
                let values: &[f32; $lanes] = values.first_chunk().expect("as many values as lanes");
                let mut lanes = [0 as $scalar; $lanes];
                for lane in 0..$lanes {
                    lanes[lane] = values[lane] as $scalar;
                }
                // SAFETY: a register is its lanes, one after the other.
                Self(unsafe { std::mem::transmute::<[$scalar; $lanes], $raw>(lanes) })
            }

            #[inline(always)]
            fn store(self, values: &mut [f32]) {
                let values: &mut [f32; $lanes] = values.first_chunk_mut().expect("as many values as lanes");
                // SAFETY: a register is its lanes, one after the other.
                let lanes = unsafe { std::mem::transmute::<$raw, [$scalar; $lanes]>(self.0) };
                for lane in 0..$lanes {
                    values[lane] = lanes[lane] as f32;
                }
            }

            #[inline(always)]
            fn sqrt(self) -> Self {
                Self(unsafe { $sqrt(self.0) })
            }

            #[inline(always)]
            fn mul_add(self, factor: Self, summand: Self) -> Self {
                let ($factor, $other, $summand) = (self, factor, summand);
                $mul_add
            }

            #[inline(always)]
            fn exp2_integer(self) -> Self {
                let $power = self;
                $exp2_integer
            }

            // The instructions return their second operand where either is NaN.
            #[inline(always)]
            fn max(self, other: Self) -> Self {
                Self(unsafe { $max(other.0, self.0) })
            }

            #[inline(always)]
            fn min(self, other: Self) -> Self {
                Self(unsafe { $min(self.0, other.0) })
            }

            #[inline(always)]
            fn select_lt(self, limit: Self, then: Self, otherwise: Self) -> Self {
                let ($value, $limit, $then, $otherwise) = (self.0, limit.0, then.0, otherwise.0);
                Self(unsafe { $select })
            }

            #[inline(always)]
            fn any_lt(self, limit: Self) -> bool {
                let ($value, $limit) = (self.0, limit.0);
                unsafe { $any }
            }

            #[inline(always)]
            fn sin_cos(self) -> (Self, Self) {
                $sin_cos(self)
            }

            #[inline(always)]
            fn vectorise<K: SimdKernel>(kernel: K) -> K::Output {
                #[target_feature(enable = $feature)]
                fn compiled_for_the_set<K: SimdKernel>(kernel: K) -> K::Output {
                    kernel.run()
                }
                // SAFETY: this type is reached through `with_f32` and `with_f64` only, with the proof.
                unsafe { compiled_for_the_set(kernel) }
            }
        }
    };
}

register! {
    /// Sixteen lanes of single precision in a register of AVX-512.
    Avx512F32(__m512): 16 of f32, "avx512f", sin_cos_single,
    _mm512_set1_ps, _mm512_add_ps, _mm512_sub_ps, _mm512_mul_ps, _mm512_div_ps, _mm512_sqrt_ps, _mm512_max_ps,
    _mm512_min_ps,
    |value| _mm512_castsi512_ps(_mm512_xor_si512(_mm512_castps_si512(value), _mm512_set1_epi32(i32::MIN))),
    |value, factor, summand| Self(unsafe { _mm512_fmadd_ps(value.0, factor.0, summand.0) }),
    |power| Self(unsafe { _mm512_castsi512_ps(_mm512_slli_epi32::<23>(_mm512_add_epi32(
        _mm512_cvtps_epi32(power.0), _mm512_set1_epi32(127)))) }),
    |value, limit, then, otherwise|
        _mm512_mask_blend_ps(_mm512_cmp_ps_mask::<_CMP_LT_OQ>(value, limit), otherwise, then),
    any _mm512_cmp_ps_mask::<_CMP_LT_OQ>(value, limit) != 0
}

register! {
    /// Eight lanes of single precision in a register of AVX2.
    Avx2F32(__m256): 8 of f32, "avx2,fma", sin_cos_single,
    _mm256_set1_ps, _mm256_add_ps, _mm256_sub_ps, _mm256_mul_ps, _mm256_div_ps, _mm256_sqrt_ps, _mm256_max_ps,
    _mm256_min_ps,
    |value| _mm256_xor_ps(value, _mm256_set1_ps(-0.0)),
    |value, factor, summand| Self(unsafe { _mm256_fmadd_ps(value.0, factor.0, summand.0) }),
    |power| Self(unsafe { _mm256_castsi256_ps(_mm256_slli_epi32::<23>(_mm256_add_epi32(
        _mm256_cvtps_epi32(power.0), _mm256_set1_epi32(127)))) }),
    |value, limit, then, otherwise|
        _mm256_blendv_ps(otherwise, then, _mm256_cmp_ps::<_CMP_LT_OQ>(value, limit)),
    any _mm256_movemask_ps(_mm256_cmp_ps::<_CMP_LT_OQ>(value, limit)) != 0
}

register! {
    /// Four lanes of single precision in a register of SSE2, which every x86-64 processor has.
    Sse2F32(__m128): 4 of f32, "sse2", sin_cos_single,
    _mm_set1_ps, _mm_add_ps, _mm_sub_ps, _mm_mul_ps, _mm_div_ps, _mm_sqrt_ps, _mm_max_ps, _mm_min_ps,
    |value| _mm_xor_ps(value, _mm_set1_ps(-0.0)),
    |value, factor, summand| lane_by_lane_mul_add(value, factor, summand),
    |power| Self(unsafe { _mm_castsi128_ps(_mm_slli_epi32::<23>(_mm_add_epi32(
        _mm_cvtps_epi32(power.0), _mm_set1_epi32(127)))) }),
    |value, limit, then, otherwise| {
        let less = _mm_cmplt_ps(value, limit);
        _mm_or_ps(_mm_and_ps(less, then), _mm_andnot_ps(less, otherwise))
    },
    any _mm_movemask_ps(_mm_cmplt_ps(value, limit)) != 0
}

register! {
    /// Four lanes of double precision in a register of AVX2.
    Avx2F64(__m256d): 4 of f64, "avx2,fma", sin_cos_double,
    _mm256_set1_pd, _mm256_add_pd, _mm256_sub_pd, _mm256_mul_pd, _mm256_div_pd, _mm256_sqrt_pd, _mm256_max_pd,
    _mm256_min_pd,
    |value| _mm256_xor_pd(value, _mm256_set1_pd(-0.0)),
    |value, factor, summand| Self(unsafe { _mm256_fmadd_pd(value.0, factor.0, summand.0) }),
    |power| Self(unsafe { _mm256_castsi256_pd(_mm256_slli_epi64::<52>(_mm256_add_epi64(
        _mm256_cvtepi32_epi64(_mm256_cvtpd_epi32(power.0)), _mm256_set1_epi64x(1023)))) }),
    |value, limit, then, otherwise|
        _mm256_blendv_pd(otherwise, then, _mm256_cmp_pd::<_CMP_LT_OQ>(value, limit)),
    any _mm256_movemask_pd(_mm256_cmp_pd::<_CMP_LT_OQ>(value, limit)) != 0
}

register! {
    /// Eight lanes of double precision in a register of AVX-512.
    Avx512F64(__m512d): 8 of f64, "avx512f", sin_cos_double,
    _mm512_set1_pd, _mm512_add_pd, _mm512_sub_pd, _mm512_mul_pd, _mm512_div_pd, _mm512_sqrt_pd, _mm512_max_pd,
    _mm512_min_pd,
    |value| _mm512_castsi512_pd(_mm512_xor_si512(_mm512_castpd_si512(value), _mm512_set1_epi64(i64::MIN))),
    |value, factor, summand| Self(unsafe { _mm512_fmadd_pd(value.0, factor.0, summand.0) }),
    |power| Self(unsafe { _mm512_castsi512_pd(_mm512_slli_epi64::<52>(_mm512_add_epi64(
        _mm512_cvtepi32_epi64(_mm512_cvtpd_epi32(power.0)), _mm512_set1_epi64(1023)))) }),
    |value, limit, then, otherwise|
        _mm512_mask_blend_pd(_mm512_cmp_pd_mask::<_CMP_LT_OQ>(value, limit), otherwise, then),
    any _mm512_cmp_pd_mask::<_CMP_LT_OQ>(value, limit) != 0
}

/// `value · factor + summand`, rounded once, for registers without such an instruction.
#[inline(always)]
fn lane_by_lane_mul_add(mut value: Sse2F32, factor: Sse2F32, summand: Sse2F32) -> Sse2F32 {
    for lane in 0..Sse2F32::LANES {
        let fused = (value.get(lane) as f32).mul_add(factor.get(lane) as f32, summand.get(lane) as f32);
        value.set(lane, f64::from(fused));
    }
    value
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use crate::{F32x4, InstructionSet, SimdFloat, SimdKernel, SimdTask, with_f32, with_f64};

    /// Every operation on two numbers, in the last lane.
    #[derive(Clone, Copy)]
    struct EveryOperation(f64, f64);

    struct OnRegisters<T>(T, T);

    impl<T: SimdFloat> SimdKernel for OnRegisters<T> {
        type Output = [u64; 16];

        #[inline(always)]
        fn run(self) -> [u64; 16] {
            let Self(x, y) = self;
            let (sin, cos) = x.sin_cos();
            let selected = x.select_lt(y, x * x, y);
            let power = T::splat(-3.0).exp2_integer();
            let mut memory = [0.0; 16];
            x.store(&mut memory[..T::LANES]);
            let copied = T::load(&memory);
            let zero = T::splat(0.0);
            let mut last = zero;
            last.set(T::LANES - 1, 1.0);
            let is_any = |found: bool| T::splat(f64::from(u8::from(found)));
            let results = [
                x + y,
                x - y,
                x * y,
                x / y,
                -x,
                x.sqrt(),
                x.max(y),
                x.min(y),
                x.mul_add(y, x),
                power,
                selected,
                sin,
                cos,
                copied,
                is_any(x.any_lt(y)),
                is_any(zero.any_lt(last)),
            ];
            // The payload of a NaN differs between processors.
            results.map(|result| {
                let value = result.get(T::LANES - 1);
                if value.is_nan() { f64::NAN.to_bits() } else { value.to_bits() }
            })
        }
    }

    impl SimdTask for EveryOperation {
        type Output = [u64; 16];

        fn run<T: SimdFloat>(self) -> [u64; 16] {
            T::vectorise(OnRegisters(T::splat(self.0), T::splat(self.1)))
        }
    }

    fn number() -> impl Strategy<Value = f64> {
        let special = prop::sample::select(vec![0.0, -0.0, f64::INFINITY, f64::NEG_INFINITY, f64::NAN, 1.0]);
        prop_oneof![1 => special, 3 => -30.0..30.0f64]
    }

    proptest! {
        #[test]
        fn every_instruction_set_gives_the_same_bits(a in number(), b in number()) {
            let task = EveryOperation(a, b);
            let (single, double) = (task.run::<F32x4>(), task.run::<f64>());
            for instructions in InstructionSet::available() {
                prop_assert_eq!(with_f32(instructions, task), single, "{}", instructions);
                prop_assert_eq!(with_f64(instructions, task), double, "{}", instructions);
            }
        }
    }
}
