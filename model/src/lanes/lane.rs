//! One number for each of several robots, and what can be done with it.
//!
//! Only additions, multiplications, divisions, square roots and comparisons, never a fused multiply-add and never a sum
//! over lanes: each lane's bits are the same whatever its neighbours are, how many there are, and which instruction set
//! runs.
//!
//! Nothing on lanes takes a closure: one that the compiler leaves out of line is compiled for the oldest processor, and
//! costs more than all the rest.

use std::ops::{Add, AddAssign, Div, Mul, Neg, Sub, SubAssign};

/// One number for each of [`Lane::LANES`] robots.
pub trait SimdFloat:
    Copy
    + Add<Output = Self>
    + Sub<Output = Self>
    + Mul<Output = Self>
    + Div<Output = Self>
    + Neg<Output = Self>
    + AddAssign
    + SubAssign
    + Send
    + Sync
    + 'static
{
    /// Number of robots.
    const LANES: usize;

    /// The same value for every robot.
    fn splat(value: f64) -> Self;
    /// The value of one robot.
    fn get(&self, lane: usize) -> f64;
    /// Sets the value of one robot.
    fn set(&mut self, lane: usize, value: f64);
    /// Square root.
    fn sqrt(self) -> Self;
    /// The larger; `self` where either is not a number.
    fn max(self, other: Self) -> Self;
    /// The smaller; `other` where either is not a number.
    fn min(self, other: Self) -> Self;
    /// The absolute value.
    #[inline(always)]
    #[must_use]
    fn abs(self) -> Self {
        self.max(-self)
    }
    /// `then` where `self < limit`, else `otherwise`.
    fn select_lt(self, limit: Self, then: Self, otherwise: Self) -> Self;
    /// True if `self < limit` for any robot.
    fn any_lt(self, limit: Self) -> bool;
    /// Sine and cosine; within a few units in the last place for |x| < 100.
    fn sin_cos(self) -> (Self, Self);
}

/// Implements the operators of a lane type by its inherent functions `plus`, `minus`, `times`, `over` and `negated`.
macro_rules! operators {
    ($lanes:ty) => {
        operators!($lanes, Add, add, plus);
        operators!($lanes, Sub, sub, minus);
        operators!($lanes, Mul, mul, times);
        operators!($lanes, Div, div, over);

        impl std::ops::Neg for $lanes {
            type Output = Self;
            #[inline(always)]
            fn neg(self) -> Self {
                self.negated()
            }
        }

        impl std::ops::AddAssign for $lanes {
            #[inline(always)]
            fn add_assign(&mut self, other: Self) {
                *self = self.plus(other);
            }
        }

        impl std::ops::SubAssign for $lanes {
            #[inline(always)]
            fn sub_assign(&mut self, other: Self) {
                *self = self.minus(other);
            }
        }
    };
    ($lanes:ty, $trait:ident, $operator:ident, $function:ident) => {
        impl std::ops::$trait for $lanes {
            type Output = Self;
            #[inline(always)]
            fn $operator(self, other: Self) -> Self {
                self.$function(other)
            }
        }
    };
}
pub(super) use operators;

/// Four robots in single precision on any processor, left to the compiler: a register of NEON.
#[derive(Clone, Copy, Debug, PartialEq)]
#[repr(align(16))]
pub struct F32x4([f32; 4]);

operators!(F32x4);

macro_rules! lanewise {
    ($function:ident, $operator:tt) => {
        #[inline(always)]
        fn $function(mut self, other: Self) -> Self {
            for lane in 0..4 {
                self.0[lane] $operator other.0[lane];
            }
            self
        }
    };
}

impl F32x4 {
    lanewise!(plus, +=);
    lanewise!(minus, -=);
    lanewise!(times, *=);
    lanewise!(over, /=);

    #[inline(always)]
    fn negated(mut self) -> Self {
        for lane in 0..4 {
            self.0[lane] = -self.0[lane];
        }
        self
    }
}

impl SimdFloat for F32x4 {
    const LANES: usize = 4;

    #[inline(always)]
    fn splat(value: f64) -> Self {
        Self([value as f32; 4])
    }

    #[inline(always)]
    fn get(&self, lane: usize) -> f64 {
        f64::from(self.0[lane])
    }

    #[inline(always)]
    fn set(&mut self, lane: usize, value: f64) {
        self.0[lane] = value as f32;
    }

    #[inline(always)]
    fn sqrt(mut self) -> Self {
        for lane in 0..4 {
            self.0[lane] = self.0[lane].sqrt();
        }
        self
    }

    #[inline(always)]
    fn max(self, other: Self) -> Self {
        self.select_lt(other, other, self)
    }

    #[inline(always)]
    fn min(self, other: Self) -> Self {
        self.select_lt(other, self, other)
    }

    #[inline(always)]
    fn select_lt(self, limit: Self, then: Self, otherwise: Self) -> Self {
        let mut result = otherwise;
        for lane in 0..4 {
            result.0[lane] = if self.0[lane] < limit.0[lane] { then.0[lane] } else { otherwise.0[lane] };
        }
        result
    }

    #[inline(always)]
    fn any_lt(self, limit: Self) -> bool {
        let mut any = false;
        for lane in 0..4 {
            any |= self.0[lane] < limit.0[lane];
        }
        any
    }

    #[inline(always)]
    fn sin_cos(self) -> (Self, Self) {
        sin_cos_single(self)
    }
}

/// One robot in double precision: for references and for identification.
impl SimdFloat for f64 {
    const LANES: usize = 1;

    #[inline(always)]
    fn splat(value: f64) -> Self {
        value
    }

    #[inline(always)]
    fn get(&self, _: usize) -> f64 {
        *self
    }

    #[inline(always)]
    fn set(&mut self, _: usize, value: f64) {
        *self = value;
    }

    #[inline(always)]
    fn sqrt(self) -> Self {
        f64::sqrt(self)
    }

    #[inline(always)]
    fn max(self, other: Self) -> Self {
        self.select_lt(other, other, self)
    }

    #[inline(always)]
    fn min(self, other: Self) -> Self {
        self.select_lt(other, self, other)
    }

    #[inline(always)]
    fn select_lt(self, limit: Self, then: Self, otherwise: Self) -> Self {
        if self < limit { then } else { otherwise }
    }

    #[inline(always)]
    fn any_lt(self, limit: Self) -> bool {
        self < limit
    }

    #[inline(always)]
    fn sin_cos(self) -> (Self, Self) {
        sin_cos_double(self)
    }
}

/// Sine and cosine in single precision without a branch or an integer: Cody-Waite reduction to ±π/2, then Taylor
/// polynomials.
#[inline(always)]
pub(super) fn sin_cos_single<T: SimdFloat>(x: T) -> (T, T) {
    let (r, sign) = reduced(x, 12_582_912.0, [3.140_625, 9.670_257_568_359_375e-4, 6.277_114_152_908_325e-7]);
    (sign * sine::<T, 6>(r), sign * cosine::<T, 7>(r))
}

/// As [`sin_cos_single`], in double precision.
#[inline(always)]
pub(super) fn sin_cos_double<T: SimdFloat>(x: T) -> (T, T) {
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
pub(super) fn exponential<T: SimdFloat>(x: T) -> T {
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
