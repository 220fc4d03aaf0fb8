//! Random numbers and ids from the entropy of the operating system.

use std::collections::hash_map::RandomState;
use std::hash::{BuildHasher, Hasher};

/// Returns a random number from the entropy of the operating system.
pub fn random_u64() -> u64 {
    RandomState::new().build_hasher().finish()
}

/// Returns a random id of 16 hexadecimal digits.
pub fn random_id() -> String {
    format!("{:016x}", random_u64())
}
