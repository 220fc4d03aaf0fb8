//! Random changes to bytes and texts.

use rand::RngExt;
use twinstep_model::Stream;

/// Maximum length of a mutated input [bytes].
pub const MAX_LEN: usize = 64 << 10;
/// Maximum number of changes to one input.
const MAX_CHANGES: u32 = 6;
/// Texts that replace a number in a text file.
const NUMBERS: [&str; 20] = [
    "nan",
    "inf",
    "-inf",
    "1e308",
    "-1e308",
    "1e-320",
    "0",
    "-0.0",
    "-1",
    "1",
    "255",
    "256",
    "65536",
    "4294967296",
    "18446744073709551615",
    "99999999999999999999",
    "1e999",
    "0x10",
    "null",
    "\"1\"",
];
/// Bytes that have a meaning in TOML, JSON, XML or CSV, and two that no text has.
const MARKS: &[u8] = b"\"'[]{}<>=,:/\\#@. \n\t\0\xff";
/// First bytes of MessagePack values with a length of 16 or 32 bits: bin, str, array, map.
const LENGTHS: [u8; 8] = [0xc5, 0xc6, 0xda, 0xdb, 0xdc, 0xdd, 0xde, 0xdf];

/// Returns a changed copy of `base`. `others` are examples from which parts are copied.
pub fn mutate(random: &mut Stream, base: &[u8], others: &[Vec<u8>], is_text: bool) -> Vec<u8> {
    let mut bytes = base.to_vec();
    // Few changes leave most of an input valid, so that it reaches the later checks.
    let changes = 1 + random.random::<u32>().trailing_ones().min(MAX_CHANGES - 1);
    for _ in 0..changes {
        if is_text && random.random_range(0..4) > 0 {
            change_text(random, &mut bytes, others);
        } else {
            change_bytes(random, &mut bytes, others);
        }
        bytes.truncate(MAX_LEN);
    }
    bytes
}

/// Returns a position in `bytes`; 0 if there are none.
fn position(random: &mut Stream, bytes: &[u8]) -> usize {
    if bytes.is_empty() { 0 } else { random.random_range(0..bytes.len()) }
}

/// Returns a range of at most `longest` bytes.
fn range(random: &mut Stream, bytes: &[u8], longest: usize) -> std::ops::Range<usize> {
    let start = position(random, bytes);
    let rest = (bytes.len() - start).min(longest);
    start..start + if rest == 0 { 0 } else { random.random_range(1..=rest) }
}

fn overwrite(bytes: &mut [u8], start: usize, with: &[u8]) {
    for (old, new) in bytes.iter_mut().skip(start).zip(with) {
        *old = *new;
    }
}

fn change_bytes(random: &mut Stream, bytes: &mut Vec<u8>, others: &[Vec<u8>]) {
    let at = position(random, bytes);
    match random.random_range(0..12) {
        0 => {
            let flipped = bytes.get(at).copied().unwrap_or(0) ^ (1 << random.random_range(0..8));
            overwrite(bytes, at, &[flipped]);
        }
        1 => overwrite(bytes, at, &[random.random()]),
        2 => overwrite(bytes, at, &[[0, 1, 0x7f, 0x80, 0xc0, 0xc1, 0xfe, 0xff][random.random_range(0..8)]]),
        3 => {
            let new: Vec<u8> = (0..random.random_range(1..9)).map(|_| random.random()).collect();
            bytes.splice(at..at, new);
        }
        4 => drop(bytes.drain(range(random, bytes, 64))),
        5 => {
            let copy = bytes[range(random, bytes, 64)].to_vec();
            bytes.splice(at..at, copy);
        }
        6 => {
            // Deep nesting, long lists.
            let copy = bytes[range(random, bytes, 32)].to_vec();
            let times =
                random.random_range(2..1 + 2 * MAX_LEN / copy.len().max(1)).min(1 << random.random_range(1..16));
            bytes.splice(at..at, copy.repeat(times));
        }
        7 => {
            let other = &others[random.random_range(0..others.len())];
            let part = other[range(random, other, 256)].to_vec();
            let end = if random.random() { at } else { (at + part.len()).min(bytes.len()) };
            bytes.splice(at..end, part);
        }
        8 => {
            let other = &others[random.random_range(0..others.len())];
            let tail = other[position(random, other)..].to_vec();
            bytes.splice(at.., tail);
        }
        9 => bytes.truncate(at),
        10 => inflate_length(random, bytes, at),
        _ => overwrite_number(random, bytes, at),
    }
}

/// Writes a large length of 1, 2, 4 or 8 bytes, or a MessagePack value that claims one.
fn inflate_length(random: &mut Stream, bytes: &mut Vec<u8>, at: usize) {
    let length: u64 = match random.random_range(0..5) {
        0 => u64::MAX,
        1 => 1 << random.random_range(8..63),
        2 => bytes.len() as u64 + random.random_range(0..64),
        3 => (1 << 31) - 1,
        _ => random.random::<u64>() >> random.random_range(0..48),
    };
    let width = [1, 2, 4, 8][random.random_range(0..4)];
    match random.random_range(0..3) {
        0 => overwrite(bytes, at, &length.to_le_bytes()[..width]),
        1 => overwrite(bytes, at, &length.to_be_bytes()[8 - width..]),
        _ => {
            let kind = LENGTHS[random.random_range(0..LENGTHS.len())];
            let header = [&[kind][..], &(length as u32).to_be_bytes()].concat();
            bytes.splice(at..at, header);
        }
    }
}

/// Writes NaN, an infinity, or a huge, negative or tiny number as 32-bit or 64-bit float, in either byte order.
fn overwrite_number(random: &mut Stream, bytes: &mut [u8], at: usize) {
    let numbers = [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, 1e38, -1e38, 1e308, -1e308, -1.0, -0.0, 1e-320, 0.0];
    let number = numbers[random.random_range(0..numbers.len())];
    match random.random_range(0..4) {
        0 => overwrite(bytes, at, &(number as f32).to_le_bytes()),
        1 => overwrite(bytes, at, &(number as f32).to_be_bytes()),
        2 => overwrite(bytes, at, &number.to_le_bytes()),
        _ => overwrite(bytes, at, &number.to_be_bytes()),
    }
}

/// Returns the ranges of words in a text; a number with sign, point and exponent is one word.
fn words(bytes: &[u8], is_number: bool) -> Vec<std::ops::Range<usize>> {
    let belongs = |byte: u8| byte.is_ascii_alphanumeric() || b"_+-.".contains(&byte);
    let mut found = Vec::new();
    let mut start = 0;
    for end in 0..=bytes.len() {
        if end == bytes.len() || !belongs(bytes[end]) {
            let word = &bytes[start..end];
            if word.iter().any(u8::is_ascii_digit) == is_number && !word.is_empty() {
                found.push(start..end);
            }
            start = end + 1;
        }
    }
    found
}

fn line(random: &mut Stream, bytes: &[u8]) -> std::ops::Range<usize> {
    let at = position(random, bytes);
    let start = bytes[..at].iter().rposition(|byte| *byte == b'\n').map_or(0, |end| end + 1);
    let end = bytes[at..].iter().position(|byte| *byte == b'\n').map_or(bytes.len(), |end| at + end + 1);
    start..end
}

fn change_text(random: &mut Stream, bytes: &mut Vec<u8>, others: &[Vec<u8>]) {
    let kind = random.random_range(0..8);
    match kind {
        0..4 => {
            let found = words(bytes, kind < 3);
            if found.is_empty() {
                return;
            }
            let word = found[random.random_range(0..found.len())].clone();
            bytes.splice(word, replacement(random, others, kind < 3));
        }
        4 => drop(bytes.drain(line(random, bytes))),
        5 => {
            let copy = bytes[line(random, bytes)].to_vec();
            let at = line(random, bytes).start;
            bytes.splice(at..at, copy);
        }
        6 => {
            let other = &others[random.random_range(0..others.len())];
            let copy = other[line(random, other)].to_vec();
            let at = line(random, bytes).start;
            bytes.splice(at..at, copy);
        }
        _ => {
            let at = position(random, bytes);
            bytes.splice(at..at, [MARKS[random.random_range(0..MARKS.len())]]);
        }
    }
}

/// Returns a number or a word of another example, or an unusual number.
fn replacement(random: &mut Stream, others: &[Vec<u8>], is_number: bool) -> Vec<u8> {
    let other = &others[random.random_range(0..others.len())];
    let found = words(other, is_number);
    if found.is_empty() || (is_number && random.random()) {
        return NUMBERS[random.random_range(0..NUMBERS.len())].into();
    }
    other[found[random.random_range(0..found.len())].clone()].to_vec()
}

#[cfg(test)]
mod tests {
    use twinstep_model::stream;

    use super::*;

    #[test]
    fn equal_streams_give_equal_inputs_and_no_input_is_too_long() {
        let examples = [b"rate_hz = 200.0\nname = \"go2\"\n".to_vec(), vec![0x81, 0xa3, b's', b'e', b'q', 7]];
        let of = |index| {
            let base = &examples[index as usize % 2];
            mutate(&mut stream(3, "test", index), base, &examples, index % 2 == 0)
        };
        for index in 0..5000 {
            assert_eq!(of(index), of(index));
            assert!(of(index).len() <= MAX_LEN);
        }
        assert!((0..100).filter(|index| of(*index) != examples[*index as usize % 2]).count() > 90);
        assert!(mutate(&mut stream(3, "test", 0), b"", &examples, true).len() <= MAX_LEN);
    }

    #[test]
    fn words_are_found_with_sign_and_exponent() {
        let text = b"kp = -1.5e3, [joint]";
        assert_eq!(words(text, true), vec![5..11]);
        assert_eq!(words(text, false), vec![0..2, 14..19]);
    }
}
