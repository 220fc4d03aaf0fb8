//! Numbers that hold one value for each of several robots.
//!
//! Only additions, multiplications, divisions, square roots and comparisons, never a fused multiply-add and never a sum
//! over lanes: each lane's bits are the same whatever its neighbours are, how many there are, and which instruction set
//! runs.
//!
//! Nothing here or above takes a closure: one that the compiler leaves out of line is compiled for the oldest processor,
//! and costs more than all the rest.

use std::ops::{Add, AddAssign, Div, Mul, Neg, Sub, SubAssign};

/// One number for each of [`Lane::LANES`] robots.
pub trait Lane:
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
    /// The larger.
    fn max(self, other: Self) -> Self;
    /// The smaller.
    fn min(self, other: Self) -> Self;
    /// `then` where `self < limit`, else `otherwise`.
    fn select_less(self, limit: Self, then: Self, otherwise: Self) -> Self;
    /// True if `self < limit` for any robot.
    fn any_less(self, limit: Self) -> bool;
    /// Sine and cosine; within a few units in the last place for |x| < 100.
    fn sin_cos(self) -> (Self, Self);
}

/// Eight robots in single precision: a register of AVX2, half a register of AVX-512, two of SSE2 or NEON.
#[derive(Clone, Copy, Debug, PartialEq)]
#[repr(align(32))]
pub struct F32x8([f32; 8]);

macro_rules! lanewise {
    ($trait:ident, $function:ident, $operator:tt) => {
        impl $trait for F32x8 {
            type Output = Self;
            #[inline(always)]
            fn $function(self, other: Self) -> Self {
                let mut result = self;
                for lane in 0..8 {
                    result.0[lane] = self.0[lane] $operator other.0[lane];
                }
                result
            }
        }
    };
}

lanewise!(Add, add, +);
lanewise!(Sub, sub, -);
lanewise!(Mul, mul, *);
lanewise!(Div, div, /);

impl Neg for F32x8 {
    type Output = Self;
    #[inline(always)]
    fn neg(self) -> Self {
        let mut result = self;
        for lane in 0..8 {
            result.0[lane] = -self.0[lane];
        }
        result
    }
}

impl AddAssign for F32x8 {
    #[inline(always)]
    fn add_assign(&mut self, other: Self) {
        *self = *self + other;
    }
}

impl SubAssign for F32x8 {
    #[inline(always)]
    fn sub_assign(&mut self, other: Self) {
        *self = *self - other;
    }
}

impl Lane for F32x8 {
    const LANES: usize = 8;

    #[inline(always)]
    fn splat(value: f64) -> Self {
        Self([value as f32; 8])
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
    fn sqrt(self) -> Self {
        let mut result = self;
        for lane in 0..8 {
            result.0[lane] = self.0[lane].sqrt();
        }
        result
    }

    #[inline(always)]
    fn max(self, other: Self) -> Self {
        self.select_less(other, other, self)
    }

    #[inline(always)]
    fn min(self, other: Self) -> Self {
        self.select_less(other, self, other)
    }

    #[inline(always)]
    fn select_less(self, limit: Self, then: Self, otherwise: Self) -> Self {
        let mut result = otherwise;
        for lane in 0..8 {
            result.0[lane] = if self.0[lane] < limit.0[lane] { then.0[lane] } else { otherwise.0[lane] };
        }
        result
    }

    #[inline(always)]
    fn any_less(self, limit: Self) -> bool {
        let mut any = false;
        for lane in 0..8 {
            any |= self.0[lane] < limit.0[lane];
        }
        any
    }

    #[inline(always)]
    fn sin_cos(self) -> (Self, Self) {
        let (mut sin, mut cos) = (self, self);
        for lane in 0..8 {
            (sin.0[lane], cos.0[lane]) = sin_cos_f32(self.0[lane]);
        }
        (sin, cos)
    }
}

/// Sine and cosine without a branch or an integer, so that the compiler runs eight at once. Cody-Waite reduction to
/// ±π/2, then Taylor polynomials.
#[inline(always)]
fn sin_cos_f32(x: f32) -> (f32, f32) {
    /// Adding and taking away 1.5 · 2²³ rounds to a whole number.
    const ROUND: f32 = 12_582_912.0;
    let turns = (x * std::f32::consts::FRAC_1_PI + ROUND) - ROUND;
    // π in three parts whose products with a small whole number are exact.
    let r = ((x - turns * 3.140_625) - turns * 9.670_257_6e-4) - turns * 6.277_114e-7;
    let half = (turns * 0.5 + ROUND) - ROUND;
    let odd = turns - 2.0 * half;
    let sign = 1.0 - 2.0 * (odd * odd);
    let s = r * r;
    let sin = r
        * (1.0 + s * (-1.0 / 6.0 + s * (1.0 / 120.0 + s * (-1.0 / 5040.0 + s * (1.0 / 362_880.0 - s / 39_916_800.0)))));
    let cos = 1.0
        + s * (-0.5
            + s * (1.0 / 24.0
                + s * (-1.0 / 720.0 + s * (1.0 / 40_320.0 + s * (-1.0 / 3_628_800.0 + s / 479_001_600.0)))));
    (sign * sin, sign * cos)
}

/// One robot in double precision: for references and for identification.
impl Lane for f64 {
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
        f64::max(self, other)
    }

    #[inline(always)]
    fn min(self, other: Self) -> Self {
        f64::min(self, other)
    }

    #[inline(always)]
    fn select_less(self, limit: Self, then: Self, otherwise: Self) -> Self {
        if self < limit { then } else { otherwise }
    }

    #[inline(always)]
    fn any_less(self, limit: Self) -> bool {
        self < limit
    }

    #[inline(always)]
    fn sin_cos(self) -> (Self, Self) {
        f64::sin_cos(self)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn sine_and_cosine_are_the_librarys(x in -20.0f32..20.0) {
            let (sin, cos) = sin_cos_f32(x);
            prop_assert!((f64::from(sin) - f64::from(x).sin()).abs() < 4e-7, "sin {x} = {sin}");
            prop_assert!((f64::from(cos) - f64::from(x).cos()).abs() < 4e-7, "cos {x} = {cos}");
        }
    }

    #[test]
    fn lanes_do_not_touch_each_other() {
        let mut values = F32x8::splat(2.0);
        values.set(3, f64::NAN);
        let result = (values * values + values).sqrt().max(F32x8::splat(1.0)).sin_cos().0;
        for lane in (0..8).filter(|lane| *lane != 3) {
            assert_eq!(result.get(lane), f64::from(sin_cos_f32(6.0f32.sqrt()).0));
        }
    }
}
