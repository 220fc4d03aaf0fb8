//! Lanes that are one register of an x86-64 processor.
//!
//! A value of these types may only be made where the processor has the instructions ([`super::Instructions`] finds
//! out), and the code that works on it belongs below one function with the matching `#[target_feature]`.

#![allow(unsafe_code, reason = "the intrinsics want the instruction set, which whoever makes a value has checked")]

#[allow(clippy::wildcard_imports, reason = "the names say where they are from")]
use std::arch::x86_64::*;

use super::lane::{SimdFloat, operators, sin_cos_double, sin_cos_single};

/// Defines a lane type over one register.
macro_rules! register {
    (
        $(#[$doc:meta])*
        $name:ident($raw:ty): $lanes:literal of $scalar:ty, $sin_cos:ident,
        $splat:ident, $plus:ident, $minus:ident, $times:ident, $over:ident, $sqrt:ident, $max:ident, $min:ident,
        |$from:ident| $negated:expr,
        |$value:ident, $limit:ident, $then:ident, $otherwise:ident| $select:expr,
        any $any:expr
    ) => {
        $(#[$doc])*
        #[derive(Clone, Copy, Debug)]
        #[repr(transparent)]
        pub struct $name($raw);

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

        impl Lane for $name {
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
            fn sqrt(self) -> Self {
                Self(unsafe { $sqrt(self.0) })
            }

            // The instructions give their second operand where either is not a number.
            #[inline(always)]
            fn max(self, other: Self) -> Self {
                Self(unsafe { $max(other.0, self.0) })
            }

            #[inline(always)]
            fn min(self, other: Self) -> Self {
                Self(unsafe { $min(self.0, other.0) })
            }

            #[inline(always)]
            fn select_less(self, limit: Self, then: Self, otherwise: Self) -> Self {
                let ($value, $limit, $then, $otherwise) = (self.0, limit.0, then.0, otherwise.0);
                Self(unsafe { $select })
            }

            #[inline(always)]
            fn any_less(self, limit: Self) -> bool {
                let ($value, $limit) = (self.0, limit.0);
                unsafe { $any }
            }

            #[inline(always)]
            fn sin_cos(self) -> (Self, Self) {
                $sin_cos(self)
            }
        }
    };
}

register! {
    /// Sixteen robots in single precision in a register of AVX-512.
    Avx512F32(__m512): 16 of f32, sin_cos_single,
    _mm512_set1_ps, _mm512_add_ps, _mm512_sub_ps, _mm512_mul_ps, _mm512_div_ps, _mm512_sqrt_ps, _mm512_max_ps,
    _mm512_min_ps,
    |value| _mm512_castsi512_ps(_mm512_xor_si512(_mm512_castps_si512(value), _mm512_set1_epi32(i32::MIN))),
    |value, limit, then, otherwise|
        _mm512_mask_blend_ps(_mm512_cmp_ps_mask::<_CMP_LT_OQ>(value, limit), otherwise, then),
    any _mm512_cmp_ps_mask::<_CMP_LT_OQ>(value, limit) != 0
}

register! {
    /// Eight robots in single precision in a register of AVX2.
    Avx2F32(__m256): 8 of f32, sin_cos_single,
    _mm256_set1_ps, _mm256_add_ps, _mm256_sub_ps, _mm256_mul_ps, _mm256_div_ps, _mm256_sqrt_ps, _mm256_max_ps,
    _mm256_min_ps,
    |value| _mm256_xor_ps(value, _mm256_set1_ps(-0.0)),
    |value, limit, then, otherwise|
        _mm256_blendv_ps(otherwise, then, _mm256_cmp_ps::<_CMP_LT_OQ>(value, limit)),
    any _mm256_movemask_ps(_mm256_cmp_ps::<_CMP_LT_OQ>(value, limit)) != 0
}

register! {
    /// Four robots in single precision in a register of SSE2, which every x86-64 processor has.
    Sse2F32(__m128): 4 of f32, sin_cos_single,
    _mm_set1_ps, _mm_add_ps, _mm_sub_ps, _mm_mul_ps, _mm_div_ps, _mm_sqrt_ps, _mm_max_ps, _mm_min_ps,
    |value| _mm_xor_ps(value, _mm_set1_ps(-0.0)),
    |value, limit, then, otherwise| {
        let less = _mm_cmplt_ps(value, limit);
        _mm_or_ps(_mm_and_ps(less, then), _mm_andnot_ps(less, otherwise))
    },
    any _mm_movemask_ps(_mm_cmplt_ps(value, limit)) != 0
}

register! {
    /// Four robots in double precision in a register of AVX2.
    Avx2F64(__m256d): 4 of f64, sin_cos_double,
    _mm256_set1_pd, _mm256_add_pd, _mm256_sub_pd, _mm256_mul_pd, _mm256_div_pd, _mm256_sqrt_pd, _mm256_max_pd,
    _mm256_min_pd,
    |value| _mm256_xor_pd(value, _mm256_set1_pd(-0.0)),
    |value, limit, then, otherwise|
        _mm256_blendv_pd(otherwise, then, _mm256_cmp_pd::<_CMP_LT_OQ>(value, limit)),
    any _mm256_movemask_pd(_mm256_cmp_pd::<_CMP_LT_OQ>(value, limit)) != 0
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::super::F32x4;
    use super::*;

    /// Every operation on numbers that include zeros of both signs, infinities and no number at all.
    #[inline(always)]
    fn every_operation<T: SimdFloat>(a: f64, b: f64) -> [u64; 11] {
        let (x, y) = (T::splat(a), T::splat(b));
        let (sin, cos) = x.sin_cos();
        let results =
            [x + y, x - y, x * y, x / y, -x, x.sqrt(), x.max(y), x.min(y), x.select_lt(y, x * x, y), sin, cos];
        // Not-a-numbers differ in their payload between processors.
        results.map(|result| {
            let value = result.get(T::LANES - 1);
            if value.is_nan() { f64::NAN.to_bits() } else { value.to_bits() }
        })
    }

    #[target_feature(enable = "avx512f")]
    fn in_avx512(a: f64, b: f64) -> [u64; 11] {
        every_operation::<Avx512F32>(a, b)
    }

    #[target_feature(enable = "avx2")]
    fn in_avx2(a: f64, b: f64) -> [[u64; 11]; 2] {
        [every_operation::<Avx2F32>(a, b), every_operation::<Avx2F64>(a, b)]
    }

    fn number() -> impl Strategy<Value = f64> {
        let special = prop::sample::select(vec![0.0, -0.0, f64::INFINITY, f64::NEG_INFINITY, f64::NAN, 1.0]);
        prop_oneof![1 => special, 3 => -30.0..30.0f64]
    }

    proptest! {
        #[test]
        fn every_instruction_set_gives_the_same_bits(a in number(), b in number()) {
            let portable = every_operation::<F32x4>(a, b);
            prop_assert_eq!(every_operation::<Sse2F32>(a, b), portable);
            if is_x86_feature_detected!("avx512f") {
                // SAFETY: the processor has it.
                prop_assert_eq!(unsafe { in_avx512(a, b) }, portable);
            }
            if is_x86_feature_detected!("avx2") {
                // SAFETY: the processor has it.
                let [single, double] = unsafe { in_avx2(a, b) };
                prop_assert_eq!(single, portable);
                prop_assert_eq!(double, every_operation::<f64>(a, b));
            }
        }
    }
}
