//! The functions between a network's layers, without a branch, so that they run in lanes.

#![allow(clippy::inline_always, reason = "what stays out of line is compiled for the oldest processor")]

use crate::wide::Wide;

/// Beyond it tanh is one in single precision.
const TANH_LIMIT: f32 = 7.905_311;
/// Odd and even part of tanh from the highest power of x² down: Eigen's `generic_fast_tanh_float`, within 3e-7.
const TANH_NUMERATOR: [f32; 7] =
    [-2.760_768_5e-16, 2.000_188e-13, -8.604_672e-11, 5.122_297e-8, 1.485_722_4e-5, 6.372_619_3e-4, 4.893_524_6e-3];
const TANH_DENOMINATOR: [f32; 4] = [1.198_258_4e-6, 1.185_347_1e-4, 2.268_434_6e-3, 4.893_525e-3];

/// tanh of one number, not fused: training runs it on processors whose fused instructions the compiler may not use.
pub fn tanh(x: f32) -> f32 {
    let x = x.clamp(-TANH_LIMIT, TANH_LIMIT);
    let s = x * x;
    let (mut above, mut below) = (TANH_NUMERATOR[0], TANH_DENOMINATOR[0]);
    for factor in &TANH_NUMERATOR[1..] {
        above = above * s + factor;
    }
    for factor in &TANH_DENOMINATOR[1..] {
        below = below * s + factor;
    }
    x * above / below
}

/// The logistic function of one number.
pub fn sigmoid(x: f32) -> f32 {
    0.5 + 0.5 * tanh(0.5 * x)
}

/// The polynomial with `coefficients` from the highest power down.
#[inline(always)]
fn polynomial<W: Wide, const N: usize>(x: W, coefficients: [f32; N]) -> W {
    let mut sum = W::splat(coefficients[0]);
    for coefficient in &coefficients[1..] {
        sum = sum.fused(x, W::splat(*coefficient));
    }
    sum
}

/// tanh within 3e-7, in lanes.
#[inline(always)]
pub fn wide_tanh<W: Wide>(x: W) -> W {
    let x = W::splat(-TANH_LIMIT).max(W::splat(TANH_LIMIT).min(x));
    let s = x.times(x);
    x.times(polynomial(s, TANH_NUMERATOR)).over(polynomial(s, TANH_DENOMINATOR))
}

/// eˣ for x ≤ 0 within 2e-7 of itself; 1e-38 below −87.
#[inline(always)]
pub fn wide_exp<W: Wide>(x: W) -> W {
    /// Adding and taking away 1.5 · 2²³ rounds to a whole number.
    const ROUND: f32 = 12_582_912.0;
    let x = W::splat(-87.0).max(x);
    let power = x.fused(W::splat(std::f32::consts::LOG2_E), W::splat(ROUND)).minus(W::splat(ROUND));
    // ln 2 in two parts, so that the product with a small whole number is exact.
    let rest = power.fused(W::splat(-0.693_359_4), x);
    let rest = power.fused(W::splat(2.121_944_4e-4), rest);
    let series = [1.0 / 5040.0, 1.0 / 720.0, 1.0 / 120.0, 1.0 / 24.0, 1.0 / 6.0, 0.5, 1.0, 1.0];
    polynomial(rest, series).times(power.power_of_two())
}

/// log(1 + eˣ) within 4e-7 of itself, or of 1e-38.
#[inline(always)]
pub fn wide_softplus<W: Wide>(x: W) -> W {
    let zero = W::splat(0.0);
    let e = wide_exp(zero.minus(x).min(x));
    // log(1 + e) = 2 atanh(e / (2 + e)), which keeps its digits where e is small.
    let s = e.over(e.plus(W::splat(2.0)));
    let series = [1.0 / 17.0, 1.0 / 15.0, 1.0 / 13.0, 1.0 / 11.0, 1.0 / 9.0, 1.0 / 7.0, 0.2, 1.0 / 3.0, 1.0];
    x.max(zero).plus(s.plus(s).times(polynomial(s.times(s), series)))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::wide::Portable;

    fn wide(function: fn(Portable) -> Portable, x: f32) -> f64 {
        f64::from(function(Portable::splat(x)).get(2))
    }

    proptest! {
        #[test]
        fn functions_are_the_librarys(x in -20.0f32..20.0) {
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
    fn what_is_no_number_stays_none() {
        for function in [wide_tanh, wide_softplus] {
            assert!(wide(function, f32::NAN).is_nan());
        }
    }
}
