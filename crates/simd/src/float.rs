//! One number in each lane of a register.
//!
//! Nothing on lanes takes a closure: one that the compiler does not inline is compiled for the oldest processor, and
//! costs more than all the rest.

use std::ops::{Add, AddAssign, Div, Mul, Neg, Sub, SubAssign};

/// Code that is compiled for the instruction set of its registers; see [`SimdFloat::vectorise`].
///
/// `run` and everything that it calls must be `#[inline(always)]`: a function that is not inlined is compiled for the
/// oldest processor.
pub trait SimdKernel {
    /// The result.
    type Output;

    /// Runs the code.
    fn run(self) -> Self::Output;
}

/// One number in each of [`SimdFloat::LANES`] lanes.
///
/// Conversions from and to `f64` round to the precision of the lanes.
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
    /// Number of lanes.
    const LANES: usize;

    /// Returns the same value in every lane.
    fn splat(value: f64) -> Self;
    /// Returns the value of one lane.
    fn get(&self, lane: usize) -> f64;
    /// Sets the value of one lane.
    fn set(&mut self, lane: usize, value: f64);
    /// Returns the first [`SimdFloat::LANES`] values of a slice.
    fn load(values: &[f32]) -> Self;
    /// Writes the lanes to the first [`SimdFloat::LANES`] entries of a slice, rounded to single precision.
    fn store(self, values: &mut [f32]);
    /// Returns the square root.
    fn sqrt(self) -> Self;
    /// Returns `self · factor + summand`, rounded once. Slow where the processor has no such instruction.
    fn mul_add(self, factor: Self, summand: Self) -> Self;
    /// Returns two to the power of `self`, which must be a whole number from −126 to 127.
    fn exp2_integer(self) -> Self;
    /// Returns the larger value; `self` where either is NaN.
    fn max(self, other: Self) -> Self;
    /// Returns the smaller value; `other` where either is NaN.
    fn min(self, other: Self) -> Self;
    /// Returns the absolute value.
    #[inline(always)]
    #[must_use]
    fn abs(self) -> Self {
        self.max(-self)
    }
    /// Returns `then` where `self < limit`, else `otherwise`.
    fn select_lt(self, limit: Self, then: Self, otherwise: Self) -> Self;
    /// Returns true if `self < limit` in any lane.
    fn any_lt(self, limit: Self) -> bool;
    /// Returns sine and cosine; within a few units in the last place for |x| < 100.
    fn sin_cos(self) -> (Self, Self);
    /// Runs a kernel that is compiled for the instruction set of this register type.
    #[inline(always)]
    fn vectorise<K: SimdKernel>(kernel: K) -> K::Output {
        kernel.run()
    }
}

/// Implements the operators of a register type by its inherent functions `plus`, `minus`, `times`, `over` and `negated`.
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
pub(crate) use operators;
