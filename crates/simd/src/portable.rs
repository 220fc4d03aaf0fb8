//! Register types that run on every processor.

use crate::float::{SimdFloat, operators};
use crate::functions;

/// Four lanes of single precision on any processor; the compiler makes a register of NEON of it on aarch64.
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
    fn load(values: &[f32]) -> Self {
        Self(*values.first_chunk().expect("as many values as lanes"))
    }

    #[inline(always)]
    fn store(self, values: &mut [f32]) {
        values[..4].copy_from_slice(&self.0);
    }

    #[inline(always)]
    fn sqrt(mut self) -> Self {
        for lane in 0..4 {
            self.0[lane] = self.0[lane].sqrt();
        }
        self
    }

    #[inline(always)]
    fn mul_add(mut self, factor: Self, summand: Self) -> Self {
        for lane in 0..4 {
            self.0[lane] = self.0[lane].mul_add(factor.0[lane], summand.0[lane]);
        }
        self
    }

    #[inline(always)]
    fn exp2_integer(mut self) -> Self {
        for lane in 0..4 {
            self.0[lane] = f32::from_bits(((self.0[lane] as i32 + 127) as u32) << 23);
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
        functions::sin_cos_single(self)
    }
}

/// One lane of double precision on any processor.
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
    fn load(values: &[f32]) -> Self {
        f64::from(values[0])
    }

    #[inline(always)]
    fn store(self, values: &mut [f32]) {
        values[0] = self as f32;
    }

    #[inline(always)]
    fn sqrt(self) -> Self {
        f64::sqrt(self)
    }

    #[inline(always)]
    fn mul_add(self, factor: Self, summand: Self) -> Self {
        f64::mul_add(self, factor, summand)
    }

    #[inline(always)]
    fn exp2_integer(self) -> Self {
        f64::from_bits(((self as i64 + 1023) as u64) << 52)
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
        functions::sin_cos_double(self)
    }
}
