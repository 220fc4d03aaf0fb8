//! TOML in files that others have written.

use serde::de::{DeserializeOwned, Error};

/// Most brackets that may be open at once. A file of this program has at most four.
const MAX_OPEN: usize = 100;

/// Parses TOML.
///
/// Refuses a text in which more than [`MAX_OPEN`] brackets are open: where brackets are not closed, the recursion of the parser is as deep as there
/// are brackets, and would overflow the stack.
pub fn parse_toml<T: DeserializeOwned>(text: &str) -> Result<T, toml::de::Error> {
    let (mut open, mut most) = (0usize, 0);
    for byte in text.bytes() {
        match byte {
            b'[' | b'{' => open += 1,
            b']' | b'}' => open = open.saturating_sub(1),
            _ => {}
        }
        most = most.max(open);
    }
    if most > MAX_OPEN {
        return Err(Error::custom(format!("{most} brackets are open at once; at most {MAX_OPEN} are expected")));
    }
    toml::from_str(text)
}

#[cfg(test)]
mod tests {
    use toml::Table;

    use super::*;

    #[test]
    fn brackets_that_are_never_closed_are_an_error_at_any_number() {
        let text = |count: usize| format!("[a]\n{}", "b = { c = 1.d\"\n[e]\n".repeat(count));
        for count in [10, 100, 100_000] {
            assert!(parse_toml::<Table>(&text(count)).is_err());
        }
        let error = parse_toml::<Table>(&text(5000)).expect_err("too many").to_string();
        assert_eq!(error.trim_end(), "5001 brackets are open at once; at most 100 are expected");
        assert!(parse_toml::<Table>("a = [[1, { b = [2] }]]\n[c]\n").is_ok());
    }
}
