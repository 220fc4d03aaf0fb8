//! Elementary functions from additions, multiplications and divisions alone, so that all lanes run the same code.

use crate::float::SimdFloat;

/// Sine and cosine in single precision without a branch or an integer: Cody-Waite reduction to ±π/2, then Taylor
/// polynomials.
#[inline(always)]
pub(crate) fn sin_cos_single<T: SimdFloat>(x: T) -> (T, T) {
    let (r, sign) = reduced(x, 12_582_912.0, [3.140_625, 9.670_257_568_359_375e-4, 6.277_114_152_908_325e-7]);
    (sign * sine::<T, 6>(r), sign * cosine::<T, 7>(r))
}

/// As [`sin_cos_single`], in double precision.
#[inline(always)]
pub(crate) fn sin_cos_double<T: SimdFloat>(x: T) -> (T, T) {
    let parts = [3.141_592_621_803_283_7, 3.178_650_942_459_171_3e-8, 1.224_646_786_410_718_9e-16];
    let (r, sign) = reduced(x, 6_755_399_441_055_744.0, parts);
    (sign * sine::<T, 11>(r), sign * cosine::<T, 12>(r))
}

/// `x` less the nearest multiple of π, and the sign that this gives sine and cosine.
///
/// Adding and taking away `round`, 1.5 · 2^(digits of the significand), rounds to a whole number. π is given in parts
/// whose products with a small whole number are exact.
#[inline(always)]
fn reduced<T: SimdFloat>(x: T, round: f64, pi: [f64; 3]) -> (T, T) {
    let round = T::splat(round);
    let turns = (x * T::splat(std::f64::consts::FRAC_1_PI) + round) - round;
    let r = ((x - turns * T::splat(pi[0])) - turns * T::splat(pi[1])) - turns * T::splat(pi[2]);
    let half = (turns * T::splat(0.5) + round) - round;
    let odd = turns - (half + half);
    let sign = T::splat(1.0) - (odd * odd + odd * odd);
    (r, sign)
}

/// The first `TERMS` terms of the sine's series.
#[inline(always)]
fn sine<T: SimdFloat, const TERMS: usize>(r: T) -> T {
    r * series::<T, TERMS>(r * r, 1)
}

/// The first `TERMS` terms of the cosine's series.
#[inline(always)]
fn cosine<T: SimdFloat, const TERMS: usize>(r: T) -> T {
    series::<T, TERMS>(r * r, 0)
}

/// `Σ (−s)^k / (2k + first)!` by Horner's rule.
#[inline(always)]
fn series<T: SimdFloat, const TERMS: usize>(s: T, first: usize) -> T {
    let mut factorial = 1.0;
    let mut coefficients = [1.0; 16];
    for k in 1..TERMS {
        let n = 2 * k + first;
        factorial *= -((n * (n - 1)) as f64);
        coefficients[k] = 1.0 / factorial;
    }
    let mut sum = T::splat(coefficients[TERMS - 1]);
    for k in (0..TERMS - 1).rev() {
        sum = T::splat(coefficients[k]) + s * sum;
    }
    sum
}

/// `e^x` for x ≤ 0, within a few parts in a million of single precision and in 10¹³ of double; 0 below −40.
///
/// The 64th root by its series, squared six times: no integers, so that lanes stay together.
#[inline(always)]
pub fn exponential<T: SimdFloat>(x: T) -> T {
    const TERMS: usize = 18;
    let root = x.max(T::splat(-40.0)) * T::splat(1.0 / 64.0);
    let mut sum = T::splat(1.0);
    for k in (1..TERMS).rev() {
        sum = T::splat(1.0) + root * sum * T::splat(1.0 / k as f64);
    }
    for _ in 0..6 {
        sum = sum * sum;
    }
    sum
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::F32x4;

    proptest! {
        #[test]
        fn sine_and_cosine_are_the_librarys(x in -20.0f64..20.0) {
            let (sin, cos) = F32x4::splat(x).sin_cos();
            let exact = f64::from(x as f32);
            prop_assert!((sin.get(0) - exact.sin()).abs() < 4e-7, "sin {x} = {sin:?}");
            prop_assert!((cos.get(3) - exact.cos()).abs() < 4e-7, "cos {x} = {cos:?}");
            let (sin, cos) = x.sin_cos();
            let (ours_sin, ours_cos) = SimdFloat::sin_cos(x);
            prop_assert!((sin - ours_sin).abs() < 2e-15 && (cos - ours_cos).abs() < 2e-15, "{x}");
        }
    }

    proptest! {
        #[test]
        fn exponential_is_the_librarys(x in -39.0f64..0.0) {
            prop_assert!((exponential(x) / x.exp() - 1.0).abs() < 1e-13, "{x}");
            let single = exponential(F32x4::splat(x)).get(1);
            prop_assert!((single / x.exp() - 1.0).abs() < 2e-5, "{x}: {single}");
        }
    }

    #[test]
    fn lanes_do_not_touch_each_other() {
        let mut values = F32x4::splat(2.0);
        values.set(2, f64::NAN);
        let result = (values * values + values).sqrt().max(F32x4::splat(1.0)).sin_cos().0;
        let alone = F32x4::splat(f64::from(6.0f32.sqrt())).sin_cos().0.get(0);
        for lane in (0..4).filter(|lane| *lane != 2) {
            assert_eq!(result.get(lane), alone);
        }
    }
}
