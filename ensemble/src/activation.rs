//! Branch-free activation functions for scalars and SIMD registers.

#![allow(clippy::inline_always, reason = "a function that is not inlined is compiled for the baseline instruction set")]

use twinstep_simd::SimdFloat;

/// Argument above which tanh is 1 in single precision.
const TANH_LIMIT: f32 = 7.905_311;
/// Coefficients of the rational approximation of tanh, from the highest power of x² down, with an error below 3e-7.
///
/// Eigen's `generic_fast_tanh_float`.
const TANH_NUMERATOR: [f32; 7] =
    [-2.760_768_5e-16, 2.000_188e-13, -8.604_672e-11, 5.122_297e-8, 1.485_722_4e-5, 6.372_619_3e-4, 4.893_524_6e-3];
const TANH_DENOMINATOR: [f32; 4] = [1.198_258_4e-6, 1.185_347_1e-4, 2.268_434_6e-3, 4.893_525e-3];

/// Returns tanh of a scalar.
///
/// Without fused multiply-adds, because training is compiled for the baseline instruction set, which has none.
pub fn tanh(x: f32) -> f32 {
    let x = x.clamp(-TANH_LIMIT, TANH_LIMIT);
    let s = x * x;
    let (mut numerator, mut denominator) = (TANH_NUMERATOR[0], TANH_DENOMINATOR[0]);
    for factor in &TANH_NUMERATOR[1..] {
        numerator = numerator * s + factor;
    }
    for factor in &TANH_DENOMINATOR[1..] {
        denominator = denominator * s + factor;
    }
    x * numerator / denominator
}

/// Returns the logistic function of a scalar.
pub fn sigmoid(x: f32) -> f32 {
    0.5 + 0.5 * tanh(0.5 * x)
}

/// Evaluates the polynomial with `coefficients`, from the highest power down.
#[inline(always)]
fn polynomial<T: SimdFloat, const N: usize>(x: T, coefficients: [f32; N]) -> T {
    let mut sum = T::splat(f64::from(coefficients[0]));
    for coefficient in &coefficients[1..] {
        sum = sum.mul_add(x, T::splat(f64::from(*coefficient)));
    }
    sum
}

/// Returns tanh of each lane, with an error below 3e-7.
#[inline(always)]
pub fn wide_tanh<T: SimdFloat>(x: T) -> T {
    let limit = T::splat(f64::from(TANH_LIMIT));
    let x = limit.min(x).max(T::splat(f64::from(-TANH_LIMIT)));
    let s = x * x;
    x * polynomial(s, TANH_NUMERATOR) / polynomial(s, TANH_DENOMINATOR)
}

/// Returns eˣ for x ≤ 0 with a relative error below 2e-7; about 1e-38 for x < −87.
#[inline(always)]
pub fn wide_exp<T: SimdFloat>(x: T) -> T {
    /// Adding and subtracting 1.5 · 2²³ rounds to an integer.
    const ROUND: f64 = 12_582_912.0;
    let x = x.max(T::splat(-87.0));
    let round = T::splat(ROUND);
    let power = x.mul_add(T::splat(f64::from(std::f32::consts::LOG2_E)), round) - round;
    // ln 2 in two parts, so that the product of the first with a small integer is exact.
    let rest = power.mul_add(T::splat(f64::from(-0.693_359_4f32)), x);
    let rest = power.mul_add(T::splat(f64::from(2.121_944_4e-4f32)), rest);
    let series = [1.0 / 5040.0, 1.0 / 720.0, 1.0 / 120.0, 1.0 / 24.0, 1.0 / 6.0, 0.5, 1.0, 1.0];
    polynomial(rest, series) * power.exp2_integer()
}

/// Returns log(1 + eˣ) with a relative error below 4e-7, or an absolute error below 1e-38.
#[inline(always)]
pub fn wide_softplus<T: SimdFloat>(x: T) -> T {
    let zero = T::splat(0.0);
    let e = wide_exp((zero - x).min(x));
    // log(1 + e) = 2 atanh(e / (2 + e)) is accurate for small e.
    let s = e / (e + T::splat(2.0));
    let series = [1.0 / 17.0, 1.0 / 15.0, 1.0 / 13.0, 1.0 / 11.0, 1.0 / 9.0, 1.0 / 7.0, 0.2, 1.0 / 3.0, 1.0];
    zero.max(x) + (s + s) * polynomial(s * s, series)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use twinstep_simd::F32x4;

    fn wide(function: fn(F32x4) -> F32x4, x: f32) -> f64 {
        function(F32x4::splat(f64::from(x))).get(2)
    }

    proptest! {
        #[test]
        fn functions_agree_with_the_standard_library(x in -20.0f32..20.0) {
            let exact = f64::from(x);
            prop_assert!((wide(wide_tanh, x) - exact.tanh()).abs() < 4e-7);
            prop_assert!((f64::from(tanh(x)) - exact.tanh()).abs() < 4e-7);
            prop_assert!((f64::from(sigmoid(x)) - 1.0 / (1.0 + (-exact).exp())).abs() < 4e-7);
            prop_assert!((wide(wide_exp, -x.abs()) / (-exact.abs()).exp() - 1.0).abs() < 4e-7);
            prop_assert!((wide(wide_softplus, x) / exact.exp().ln_1p() - 1.0).abs() < 8e-7);
        }
    }

    #[test]
    fn ends_of_the_range_are_finite() {
        assert!(wide(wide_exp, -1e30) >= 0.0 && wide(wide_exp, -1e30) < 1e-37);
        assert_eq!(wide(wide_exp, 0.0), 1.0);
        assert_eq!(wide(wide_softplus, 1e30), f64::from(1e30f32));
        assert!(wide(wide_softplus, -1e30) < 1e-37);
    }

    #[test]
    fn nan_propagates() {
        for function in [wide_tanh, wide_softplus] {
            assert!(wide(function, f32::NAN).is_nan());
        }
    }
}
