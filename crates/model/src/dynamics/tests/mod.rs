//! Tests of the SIMD dynamics in double precision.

mod actuators;
mod equations;
