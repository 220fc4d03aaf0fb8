//! Opens a Zenoh session.
//!
//! `zenoh::open` is generic: every crate that calls it compiles Zenoh's runtime again, which takes 21 s. Server and
//! client call this function instead.

use zenoh::{Config, Session, Wait};

/// Opens a session and waits until it is open.
pub fn open(config: Config) -> Result<Session, zenoh::Error> {
    zenoh::open(config).wait()
}

/// Returns the text of an error without the lines of source code that Zenoh puts into it.
pub fn reason(error: &zenoh::Error) -> String {
    without_source_lines(&error.to_string())
}

/// Removes each ` at /path/file.rs:12.`, which is a place on the machine that built the program.
fn without_source_lines(text: &str) -> String {
    let mut kept = String::new();
    let mut rest = text;
    while let Some(start) = rest.find(" at /") {
        let place = rest[start + 4..].split_whitespace().next().unwrap_or_default();
        kept.push_str(&rest[..start]);
        rest = &rest[start + 4..];
        if place.contains(".rs:") {
            rest = &rest[place.len()..];
        } else {
            kept.push_str(" at ");
        }
    }
    (kept + rest).trim_end_matches([' ', '.']).to_owned()
}

#[cfg(test)]
mod tests {
    use super::without_source_lines;

    #[test]
    fn places_in_source_code_are_removed() {
        let text = "Unable to bind at /build/zenoh/link.rs:12. - Caused by: Address in use at /build/tcp.rs:7.";
        assert_eq!(without_source_lines(text), "Unable to bind - Caused by: Address in use");
        assert_eq!(without_source_lines("no file at /etc/zenoh.json5"), "no file at /etc/zenoh.json5");
    }
}
