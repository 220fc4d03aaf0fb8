//! CDR, the encoding of DDS messages (OMG XCDR version 1): values are aligned to their size, relative to the body.

/// Length of the header with encoding and options [bytes].
const HEADER: usize = 4;
/// Length from which bytes behind the last field are not padding [bytes].
const MAX_PADDING: usize = 8;

/// Reason why bytes are not a message of the expected type.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum CdrError {
    /// The bytes end inside a value.
    #[error("it ends after {bytes} bytes, but a message of this type has {expected}")]
    TooShort {
        /// Number of bytes.
        bytes: usize,
        /// Expected number of bytes.
        expected: usize,
    },
    /// There are too many bytes.
    #[error("it has {bytes} bytes, but a message of this type has {expected}")]
    TooLong {
        /// Number of bytes.
        bytes: usize,
        /// Expected number of bytes.
        expected: usize,
    },
    /// The header has another encoding.
    #[error("its header is {header:02x?}, but plain CDR starts with 00 00 or 00 01")]
    Encoding {
        /// First two bytes of the header.
        header: [u8; 2],
    },
    /// A string is not UTF-8 with a zero at its end.
    #[error("the string at byte {at} is not UTF-8 with a zero at its end")]
    Text {
        /// Offset of the string in the body [bytes].
        at: usize,
    },
}

/// Primitive type in CDR encoding.
pub trait Primitive: Copy + Default {
    /// Size and alignment [bytes].
    const SIZE: usize;
    /// Returns the value of [`Primitive::SIZE`] bytes.
    fn read(bytes: &[u8], little_endian: bool) -> Self;
    /// Appends the value, little-endian.
    fn append(self, bytes: &mut Vec<u8>);
}

macro_rules! primitives {
    ($($number:ty),*) => {$(
        impl Primitive for $number {
            const SIZE: usize = size_of::<$number>();
            fn read(bytes: &[u8], little_endian: bool) -> Self {
                let mut value = [0; size_of::<$number>()];
                value.copy_from_slice(bytes);
                if little_endian { Self::from_le_bytes(value) } else { Self::from_be_bytes(value) }
            }
            fn append(self, bytes: &mut Vec<u8>) {
                bytes.extend(self.to_le_bytes());
            }
        }
    )*};
}
primitives!(u8, u16, i16, u32, i32, i64, f32);

/// Visitor of a message's fields, in their order, for reading and writing.
pub trait FieldVisitor {
    /// Visits a value.
    fn value<T: Primitive>(&mut self, value: &mut T);

    /// Visits consecutive values.
    fn array<T: Primitive>(&mut self, values: &mut [T]) {
        for value in values {
            self.value(value);
        }
    }

    /// Visits a structure.
    fn structure(&mut self, structure: &mut impl Message)
    where
        Self: Sized,
    {
        structure.visit_fields(self);
    }

    /// Visits a sequence of bytes of any length.
    fn bytes(&mut self, bytes: &mut Vec<u8>);

    /// Visits a string.
    fn string(&mut self, text: &mut String);
}

/// Message or structure with known fields.
pub trait Message: Clone + Default {
    /// Visits every field in its order.
    fn visit_fields(&mut self, fields: &mut impl FieldVisitor);
}

/// Decodes a payload: header and body.
pub fn decode<M: Message>(payload: &[u8]) -> Result<M, CdrError> {
    if let [0, 0 | 1, ..] | [] | [_] = payload {
    } else {
        return Err(CdrError::Encoding { header: [payload[0], payload[1]] });
    }
    let little_endian = payload.get(1) == Some(&1);
    let mut reader = Reader { body: payload.get(HEADER..).unwrap_or(&[]), at: 0, little_endian, bad_text: None };
    let mut message = M::default();
    message.visit_fields(&mut reader);
    let (bytes, expected) = (payload.len(), reader.at.saturating_add(HEADER));
    if bytes < expected {
        return Err(CdrError::TooShort { bytes, expected });
    }
    // Some recorders pad the payload to a multiple of four or eight bytes.
    if bytes >= expected + MAX_PADDING {
        return Err(CdrError::TooLong { bytes, expected });
    }
    reader.bad_text.map_or(Ok(message), |at| Err(CdrError::Text { at }))
}

/// Encodes a message as little-endian payload: header and body.
pub fn encode<M: Message>(message: &M) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(HEADER + size_of::<M>());
    bytes.extend([0, 1, 0, 0]);
    // One visitor reads and writes, so it needs a message that can be changed.
    message.clone().visit_fields(&mut Writer { bytes: &mut bytes });
    bytes
}

/// Reader of a body. Behind the end it only counts, so that the expected length is known.
struct Reader<'a> {
    body: &'a [u8],
    at: usize,
    little_endian: bool,
    /// Offset of the first string that is not text.
    bad_text: Option<usize>,
}

impl<'a> Reader<'a> {
    fn take(&mut self, length: usize) -> Option<&'a [u8]> {
        let start = self.at;
        self.at = start.saturating_add(length);
        self.body.get(start..self.at)
    }

    fn sequence(&mut self) -> Option<&'a [u8]> {
        let mut length = 0_u32;
        self.value(&mut length);
        self.take(length as usize)
    }
}

impl FieldVisitor for Reader<'_> {
    fn value<T: Primitive>(&mut self, value: &mut T) {
        self.at = self.at.checked_next_multiple_of(T::SIZE).unwrap_or(usize::MAX);
        let little_endian = self.little_endian;
        *value = self.take(T::SIZE).map_or(T::default(), |bytes| T::read(bytes, little_endian));
    }

    fn bytes(&mut self, bytes: &mut Vec<u8>) {
        *bytes = self.sequence().unwrap_or_default().to_vec();
    }

    fn string(&mut self, text: &mut String) {
        let at = self.at;
        let Some(bytes) = self.sequence() else { return };
        match bytes.split_last().map(|(end, text)| (end, str::from_utf8(text))) {
            Some((0, Ok(found))) => found.clone_into(text),
            _ => self.bad_text = self.bad_text.or(Some(at)),
        }
    }
}

struct Writer<'a> {
    bytes: &'a mut Vec<u8>,
}

impl FieldVisitor for Writer<'_> {
    fn value<T: Primitive>(&mut self, value: &mut T) {
        let start = HEADER + (self.bytes.len() - HEADER).next_multiple_of(T::SIZE);
        self.bytes.resize(start, 0);
        value.append(self.bytes);
    }

    fn bytes(&mut self, bytes: &mut Vec<u8>) {
        self.value(&mut (bytes.len() as u32));
        self.bytes.extend_from_slice(bytes);
    }

    fn string(&mut self, text: &mut String) {
        self.value(&mut (text.len() as u32 + 1));
        self.bytes.extend_from_slice(text.as_bytes());
        self.bytes.push(0);
    }
}

/// Returns a message with unequal numbers in its fields. `size` is that of the body [bytes].
#[cfg(test)]
pub(crate) fn distinct<M: Message>(size: usize) -> M {
    // Bytes below 7f are no part of a NaN.
    let body = (0..size).map(|at| (1 + at * 5 % 125) as u8);
    decode(&[0, 1, 0, 0].into_iter().chain(body).collect::<Vec<_>>()).expect("a message")
}

/// Checks that every field of a message is written and read, and the size of its body [bytes].
#[cfg(test)]
pub(crate) fn round_trips<M: Message + PartialEq + std::fmt::Debug>(size: usize) {
    let message = distinct::<M>(size);
    let payload = encode(&message);
    assert_eq!(payload.len(), HEADER + size);
    assert_eq!(decode(&payload), Ok(message));
    assert_eq!(
        decode::<M>(&payload[..payload.len() - 1]),
        Err(CdrError::TooShort { bytes: HEADER + size - 1, expected: HEADER + size })
    );
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Clone, Debug, Default, PartialEq)]
    struct Small(u8, f32, u16);

    impl Message for Small {
        fn visit_fields(&mut self, fields: &mut impl FieldVisitor) {
            fields.value(&mut self.0);
            fields.value(&mut self.1);
            fields.value(&mut self.2);
        }
    }

    #[derive(Clone, Debug, Default, PartialEq)]
    struct Variable(String, Vec<u8>, i64);

    impl Message for Variable {
        fn visit_fields(&mut self, fields: &mut impl FieldVisitor) {
            fields.string(&mut self.0);
            fields.bytes(&mut self.1);
            fields.value(&mut self.2);
        }
    }

    #[test]
    fn values_are_aligned_to_their_size() {
        let bytes = encode(&Small(7, 1.0, 0x0203));
        assert_eq!(bytes, [0, 1, 0, 0, 7, 0, 0, 0, 0, 0, 0x80, 0x3f, 3, 2]);
        assert_eq!(decode(&bytes), Ok(Small(7, 1.0, 0x0203)));
    }

    #[test]
    fn both_byte_orders_are_read() {
        let bytes = [0, 0, 0, 0, 7, 0, 0, 0, 0x3f, 0x80, 0, 0, 2, 3];
        assert_eq!(decode(&bytes), Ok(Small(7, 1.0, 0x0203)));
    }

    #[test]
    fn payload_of_another_length_or_encoding_is_rejected() {
        let bytes = encode(&Small(7, 1.0, 2));
        assert_eq!(decode::<Small>(&bytes[..9]), Err(CdrError::TooShort { bytes: 9, expected: 14 }));
        assert_eq!(decode::<Small>(&[]), Err(CdrError::TooShort { bytes: 0, expected: 14 }));
        assert_eq!(
            decode::<Small>(&[bytes.clone(), vec![0; 8]].concat()),
            Err(CdrError::TooLong { bytes: 22, expected: 14 })
        );
        assert!(decode::<Small>(&[bytes.clone(), vec![0; 2]].concat()).is_ok(), "padding at the end");
        assert_eq!(decode::<Small>(&[0, 3, 0, 0, 7]), Err(CdrError::Encoding { header: [0, 3] }));
    }

    #[test]
    fn string_has_its_length_with_a_zero_at_its_end() {
        let message = Variable("ab".to_owned(), vec![9], -2);
        let bytes = encode(&message);
        assert_eq!(bytes[4..17], [3, 0, 0, 0, b'a', b'b', 0, 0, 1, 0, 0, 0, 9]);
        assert_eq!(bytes.len(), 4 + 24, "the last value is aligned to eight bytes");
        assert_eq!(decode(&bytes), Ok(message));
    }

    #[test]
    fn string_that_is_too_long_or_not_text_is_rejected() {
        let bytes = encode(&Variable("ab".to_owned(), Vec::new(), 0));
        let with = |at: usize, byte: u8| {
            let mut bytes = bytes.clone();
            bytes[at] = byte;
            decode::<Variable>(&bytes)
        };
        assert!(matches!(with(7, 0xff), Err(CdrError::TooShort { .. })), "a length of four gigabytes");
        assert_eq!(with(8, 0xff), Err(CdrError::Text { at: 0 }));
        assert_eq!(with(10, b'c'), Err(CdrError::Text { at: 0 }), "no zero at the end");
    }
}
