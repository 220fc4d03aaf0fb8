//! Random ids and secrets from the entropy of the operating system.

use std::fmt;
use std::hint::black_box;
use std::str::FromStr;

use rand::TryRng;
use rand::rngs::SysRng;

/// Number of bytes of a [`Secret`].
pub const SECRET_BYTES: usize = 16;

/// Random bytes that a client chooses and that only its server knows: the proof that a request comes from the owner of
/// a lease.
///
/// The client attaches them to its lease request and to every request for the leased environments. They are in no
/// reply, key or log.
#[derive(Clone, Copy, Eq)]
pub struct Secret([u8; SECRET_BYTES]);

impl Secret {
    /// Returns a new random secret.
    pub fn random() -> Self {
        Self(random_bytes())
    }

    /// Returns the secret of these bytes, or `None` if there are not [`SECRET_BYTES`].
    pub fn from_bytes(bytes: &[u8]) -> Option<Self> {
        bytes.try_into().ok().map(Self)
    }

    /// Returns the bytes that are attached to requests.
    pub fn as_bytes(&self) -> &[u8] {
        &self.0
    }

    /// Returns the secret as hexadecimal digits, for a file that only the client's user can read.
    pub fn reveal(&self) -> String {
        format!("{:032x}", u128::from_be_bytes(self.0))
    }
}

/// Compares in a time that does not depend on the bytes.
impl PartialEq for Secret {
    fn eq(&self, other: &Self) -> bool {
        let differing = self.0.iter().zip(&other.0).fold(0, |differing, (ours, theirs)| differing | (ours ^ theirs));
        black_box(differing) == 0
    }
}

impl fmt::Debug for Secret {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str("Secret(…)")
    }
}

/// The text is not a revealed [`Secret`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("a secret has {} hexadecimal digits", 2 * SECRET_BYTES)]
pub struct ParseSecretError;

impl FromStr for Secret {
    type Err = ParseSecretError;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        if text.len() != 2 * SECRET_BYTES || text.starts_with('+') {
            return Err(ParseSecretError);
        }
        let number = u128::from_str_radix(text, 16).map_err(|_| ParseSecretError)?;
        Ok(Self(number.to_be_bytes()))
    }
}

/// Returns a random number.
pub fn random_u64() -> u64 {
    u64::from_le_bytes(random_bytes())
}

/// Returns a random id of 16 hexadecimal digits.
pub fn random_id() -> String {
    format!("{:016x}", random_u64())
}

fn random_bytes<const N: usize>() -> [u8; N] {
    let mut bytes = [0; N];
    SysRng.try_fill_bytes(&mut bytes).expect("the operating system provides random numbers");
    bytes
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_secret_is_not_printed_by_accident() {
        let secret = Secret::random();
        assert!(!format!("{secret:?}").contains(&secret.reveal()[..4]));
    }

    #[test]
    fn a_revealed_secret_is_parsed_back() {
        let secret = Secret::random();
        assert_eq!(secret.reveal().parse(), Ok(secret));
        assert_ne!(Secret::random(), secret);
        for text in [
            "",
            "00",
            "zz000000000000000000000000000000",
            "+0000000000000000000000000000000",
            "é00000000000000000000000000000",
        ] {
            assert_eq!(text.parse::<Secret>(), Err(ParseSecretError), "{text}");
        }
    }

    #[test]
    fn every_random_number_has_entropy_of_its_own() {
        let numbers: std::collections::HashSet<u64> = (0..1000).map(|_| random_u64()).collect();
        assert_eq!(numbers.len(), 1000);
        let ones: u32 = numbers.iter().map(|number| number.count_ones()).sum();
        // 64 000 fair bits: four standard deviations are 506.
        assert!(ones.abs_diff(32_000) < 510, "{ones} of 64000 bits are set");
    }
}
