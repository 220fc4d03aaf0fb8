use speedy::{Readable, Writable};

// TODO: Why is this module here? Can we move this to QoS?

#[derive(Debug, Clone, Copy, PartialEq, Eq, Readable, Writable)]
#[repr(u32)]
pub enum ReliabilityKind {
  BestEffort = 1,
  Reliable = 2,
}

// impl ReliabilityKind {
//   pub const BEST_EFFORT: Self = Self(1);
//   pub const RELIABLE: Self = Self(2);
// }

