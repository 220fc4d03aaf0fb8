//! The stop channel of a robot: a TCP connection of its own that damps the motors, beside Zenoh.
//!
//! The server sends a [`Greeting`] as soon as a client connects. The client sends [`answer`]. The server executes the stop
//! and sends [`STOPPED`], or [`REFUSED`], and closes the connection. Nothing else is transmitted. Where Zenoh's
//! endpoint is `tls/` or `quic/`, all of it is inside TLS.

use hmac::{Hmac, KeyInit, Mac};
use sha2::Sha256;

/// First bytes of a greeting.
const MAGIC: &[u8; 8] = b"TWSTOP1\n";
/// What the code of an answer covers, besides nonce and user.
const PURPOSE: &[u8] = b"twinstep-stop";
/// Size of the random number in a greeting [bytes].
const NONCE_BYTES: usize = 32;
/// Size of a greeting [bytes].
pub const GREETING_BYTES: usize = 8 + NONCE_BYTES;
/// Size of the code in an answer [bytes].
const CODE_BYTES: usize = 32;
/// Maximum size of a user's name [bytes].
const MAX_USER: usize = 64;
/// The robot is stopped.
pub const STOPPED: u8 = b'S';
/// User or password are wrong.
pub const REFUSED: u8 = b'R';

/// What the server sends first: with it, an answer is valid for one connection.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Greeting([u8; NONCE_BYTES]);

impl Greeting {
    /// Returns a greeting with a random number.
    pub fn random() -> Self {
        Self(std::array::from_fn(|index| (crate::random_u64() >> (8 * (index % 8))) as u8))
    }

    /// Returns the bytes to send.
    pub fn encode(self) -> [u8; GREETING_BYTES] {
        let mut bytes = [0; GREETING_BYTES];
        bytes[..8].copy_from_slice(MAGIC);
        bytes[8..].copy_from_slice(&self.0);
        bytes
    }

    /// Decodes a greeting. `None` if another service answers at this port.
    pub fn decode(bytes: &[u8; GREETING_BYTES]) -> Option<Self> {
        let (magic, nonce) = bytes.split_first_chunk()?;
        if magic == MAGIC { nonce.try_into().ok().map(Self) } else { None }
    }

    fn code(self, user: &str, password: &str) -> Hmac<Sha256> {
        let mut code = Hmac::<Sha256>::new_from_slice(password.as_bytes()).expect("a key of any length");
        for part in [PURPOSE, &self.0, user.as_bytes()] {
            code.update(part);
        }
        code
    }
}

/// Returns what a client answers to a greeting. Without users on the server, both texts are empty. `None` if the name is too
/// long.
pub fn answer(greeting: Greeting, user: &str, password: &str) -> Option<Vec<u8>> {
    let len = u8::try_from(user.len()).ok().filter(|len| usize::from(*len) <= MAX_USER)?;
    let code = greeting.code(user, password).finalize().into_bytes();
    Some([&[len], user.as_bytes(), &code].concat())
}

/// Returns the size of the rest of an answer [bytes] by its first byte; `None` if it is none.
pub fn rest_of_answer(first: u8) -> Option<usize> {
    let user = usize::from(first);
    (user <= MAX_USER).then_some(user + CODE_BYTES)
}

/// Returns true if the rest of an answer is that of a user. `password` returns the password of a user, if there is one.
pub fn is_valid(greeting: Greeting, rest: &[u8], password: impl FnOnce(&str) -> Option<String>) -> bool {
    let Some((user, code)) = rest.split_last_chunk::<CODE_BYTES>() else { return false };
    let Ok(user) = std::str::from_utf8(user) else { return false };
    password(user).is_some_and(|password| greeting.code(user, &password).verify_slice(code).is_ok())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn check(user: &str, password: &str) -> bool {
        let greeting = Greeting::random();
        let bytes = answer(greeting, user, password).expect("a short name");
        assert_eq!(rest_of_answer(bytes[0]), Some(bytes.len() - 1));
        is_valid(greeting, &bytes[1..], |user| (user == "alice").then(|| "secret".to_owned()))
    }

    #[test]
    fn answer_is_valid_for_its_user_password_and_greeting_only() {
        assert!(check("alice", "secret"));
        assert!(!check("alice", "Secret") && !check("bob", "secret") && !check("", ""));
        let old = answer(Greeting::random(), "alice", "secret").expect("a short name");
        assert!(!is_valid(Greeting::random(), &old[1..], |_| Some("secret".to_owned())), "it was recorded");
        assert!(!is_valid(Greeting::random(), &[1; 9], |_| Some(String::new())));
        assert_eq!((rest_of_answer(65), answer(Greeting::random(), &"x".repeat(65), "")), (None, None));
    }

    #[test]
    fn greeting_of_another_service_is_none() {
        let greeting = Greeting::random();
        assert_eq!(Greeting::decode(&greeting.encode()), Some(greeting));
        assert_eq!(Greeting::decode(&[b'S'; GREETING_BYTES]), None);
    }

    #[test]
    fn bytes_of_an_answer_are_the_golden_ones() {
        let greeting = Greeting(std::array::from_fn(|index| index as u8));
        let golden = std::fs::read(concat!(env!("CARGO_MANIFEST_DIR"), "/golden/stop_channel.bin")).expect("a file");
        let bytes = [&greeting.encode()[..], &answer(greeting, "alice", "change-me-1").expect("a short name")].concat();
        assert_eq!(bytes, golden);
    }
}
