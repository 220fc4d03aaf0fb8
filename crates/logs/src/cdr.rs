//! CDR, the encoding of DDS messages (OMG XCDR version 1): values are aligned to their size, relative to the body.

/// Length of the header with encoding and options [bytes].
const HEADER: usize = 4;

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
}

/// Primitive type in CDR encoding.
pub(crate) trait Primitive: Copy + Default {
    const SIZE: usize;
    fn read(bytes: &[u8], little_endian: bool) -> Self;
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
primitives!(u8, u16, i16, u32, i32, f32);

/// Visitor of a message's fields, in their order, for reading and writing.
pub(crate) trait FieldVisitor {
    /// Visits a value.
    fn value<T: Primitive>(&mut self, value: &mut T);

    /// Visits consecutive values.
    fn array<T: Primitive>(&mut self, values: &mut [T]) {
        for value in values {
            self.value(value);
        }
    }

    /// Visits `count` values that are not used; they are written as zero.
    fn unused<T: Primitive>(&mut self, count: usize) {
        for _ in 0..count {
            self.value(&mut T::default());
        }
    }
}

/// Message with known fields.
pub(crate) trait Message: Default {
    /// Size of the body [bytes].
    const SIZE: usize;
    /// Visits every field in its order.
    fn visit_fields(&mut self, fields: &mut impl FieldVisitor);
}

/// Decodes a payload.
pub(crate) fn decode<M: Message>(payload: &[u8]) -> Result<M, CdrError> {
    let expected = HEADER + M::SIZE;
    let bytes = payload.len();
    if let [0, 0 | 1, ..] | [] | [_] = payload {
    } else {
        return Err(CdrError::Encoding { header: [payload[0], payload[1]] });
    }
    if bytes < expected {
        return Err(CdrError::TooShort { bytes, expected });
    }
    // Some recorders pad the payload to a multiple of four or eight bytes.
    if bytes >= expected + 8 {
        return Err(CdrError::TooLong { bytes, expected });
    }
    let mut message = M::default();
    message.visit_fields(&mut Reader { body: &payload[HEADER..], at: 0, little_endian: payload[1] == 1 });
    Ok(message)
}

/// Encodes a message as little-endian payload.
pub(crate) fn encode<M: Message>(message: &mut M) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(HEADER + M::SIZE);
    bytes.extend([0, 1, 0, 0]);
    message.visit_fields(&mut Writer { bytes: &mut bytes });
    bytes
}

/// Reader of a body whose length was checked.
struct Reader<'a> {
    body: &'a [u8],
    at: usize,
    little_endian: bool,
}

impl FieldVisitor for Reader<'_> {
    fn value<T: Primitive>(&mut self, value: &mut T) {
        let start = self.at.next_multiple_of(T::SIZE);
        self.at = start + T::SIZE;
        *value = T::read(&self.body[start..self.at], self.little_endian);
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
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Debug, Default, PartialEq)]
    struct Small(u8, f32, u16);

    impl Message for Small {
        const SIZE: usize = 10;
        fn visit_fields(&mut self, fields: &mut impl FieldVisitor) {
            fields.value(&mut self.0);
            fields.value(&mut self.1);
            fields.value(&mut self.2);
        }
    }

    #[test]
    fn values_are_aligned_to_their_size() {
        let bytes = encode(&mut Small(7, 1.0, 0x0203));
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
        let bytes = encode(&mut Small(7, 1.0, 2));
        assert_eq!(decode::<Small>(&bytes[..9]), Err(CdrError::TooShort { bytes: 9, expected: 14 }));
        assert_eq!(decode::<Small>(&[]), Err(CdrError::TooShort { bytes: 0, expected: 14 }));
        assert_eq!(
            decode::<Small>(&[bytes.clone(), vec![0; 8]].concat()),
            Err(CdrError::TooLong { bytes: 22, expected: 14 })
        );
        assert!(decode::<Small>(&[bytes.clone(), vec![0; 2]].concat()).is_ok(), "padding at the end");
        assert_eq!(decode::<Small>(&[0, 3, 0, 0, 7]), Err(CdrError::Encoding { header: [0, 3] }));
    }
}
