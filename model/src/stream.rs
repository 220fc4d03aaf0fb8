//! Named random streams: one seed gives every consumer its own reproducible numbers.

use rand::{Rng, RngExt, SeedableRng};
use rand_xoshiro::Xoshiro256PlusPlus;
use sha2::{Digest, Sha256};

/// The generator behind every stream.
pub type Stream = Xoshiro256PlusPlus;

/// The random stream that belongs to `name` and `index` under `seed`.
///
/// Streams of other names, indices or seeds are independent, so that a new consumer shifts nobody's numbers.
pub fn stream(seed: u64, name: &str, index: u64) -> Stream {
    let digest =
        Sha256::new().chain_update(seed.to_le_bytes()).chain_update(index.to_le_bytes()).chain_update(name).finalize();
    Stream::from_seed(digest.into())
}

/// A normal number of mean 0 and deviation 1 (Box and Muller).
pub fn standard_normal(random: &mut impl Rng) -> f64 {
    let (u, v): (f64, f64) = (random.random(), random.random());
    (-2.0 * (1.0 - u).ln()).sqrt() * (std::f64::consts::TAU * v).cos()
}

#[cfg(test)]
mod tests {
    use rand::Rng;

    use super::*;

    #[test]
    fn same_name_gives_the_same_numbers_and_another_name_gives_others() {
        let mut reset = stream(7, "reset", 0);
        assert_eq!(reset.next_u64(), stream(7, "reset", 0).next_u64());
        let first = stream(7, "reset", 0).next_u64();
        for other in [stream(8, "reset", 0), stream(7, "command", 0), stream(7, "reset", 1)] {
            assert_ne!(first, { other }.next_u64());
        }
    }
}
