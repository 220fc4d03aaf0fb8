//! What the lanes compute, in double precision.

mod drive;
mod dynamics;
