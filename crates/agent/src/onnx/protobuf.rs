//! Reader of Protocol Buffers, the encoding of ONNX files.

/// Value of a field.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Value<'a> {
    /// Integer.
    Varint(u64),
    /// Text, bytes, a message, or packed numbers.
    Bytes(&'a [u8]),
    /// Four bytes, such as a float.
    Fixed32([u8; 4]),
    /// Eight bytes.
    Fixed64([u8; 8]),
}

impl<'a> Value<'a> {
    /// Returns the bytes of a message or text.
    pub fn bytes(self) -> Result<&'a [u8], String> {
        if let Value::Bytes(bytes) = self { Ok(bytes) } else { Err("a field has the wrong type".to_owned()) }
    }

    /// Returns a text.
    pub fn text(self) -> Result<String, String> {
        Ok(String::from_utf8_lossy(self.bytes()?).into_owned())
    }

    /// Returns an integer.
    pub fn integer(self) -> Result<i64, String> {
        // Negative numbers are in two's complement.
        if let Value::Varint(number) = self { Ok(number as i64) } else { Err("a field has the wrong type".to_owned()) }
    }

    /// Appends integers, packed or one.
    pub fn integers(self, numbers: &mut Vec<i64>) -> Result<(), String> {
        let Value::Bytes(mut bytes) = self else {
            numbers.push(self.integer()?);
            return Ok(());
        };
        while !bytes.is_empty() {
            numbers.push(varint(&mut bytes)? as i64);
        }
        Ok(())
    }

    /// Appends floats, packed or one.
    pub fn floats(self, numbers: &mut Vec<f32>) -> Result<(), String> {
        match self {
            Value::Fixed32(bytes) => numbers.push(f32::from_le_bytes(bytes)),
            _ => numbers.extend(self.bytes()?.as_chunks().0.iter().map(|bytes| f32::from_le_bytes(*bytes))),
        }
        Ok(())
    }

    /// Appends floats of 64 bits, packed or one.
    pub fn doubles(self, numbers: &mut Vec<f64>) -> Result<(), String> {
        match self {
            Value::Fixed64(bytes) => numbers.push(f64::from_le_bytes(bytes)),
            _ => numbers.extend(self.bytes()?.as_chunks().0.iter().map(|bytes| f64::from_le_bytes(*bytes))),
        }
        Ok(())
    }
}

/// Returns the fields of a message, with their numbers.
pub fn fields(mut bytes: &[u8]) -> Result<Vec<(u64, Value<'_>)>, String> {
    let mut fields = Vec::new();
    while !bytes.is_empty() {
        let tag = varint(&mut bytes)?;
        let value = match tag & 7 {
            0 => Value::Varint(varint(&mut bytes)?),
            1 => Value::Fixed64(array(&mut bytes)?),
            2 => {
                let len = usize::try_from(varint(&mut bytes)?).map_err(|_| truncated())?;
                Value::Bytes(take(&mut bytes, len)?)
            }
            5 => Value::Fixed32(array(&mut bytes)?),
            _ => return Err("it is not a file of Protocol Buffers".to_owned()),
        };
        fields.push((tag >> 3, value));
    }
    Ok(fields)
}

fn varint(bytes: &mut &[u8]) -> Result<u64, String> {
    let mut number = 0;
    for shift in (0..64).step_by(7) {
        let [byte] = array(bytes)?;
        number |= u64::from(byte & 0x7f) << shift;
        if byte & 0x80 == 0 {
            return Ok(number);
        }
    }
    Err("it has an integer of more than 64 bits".to_owned())
}

fn array<const N: usize>(bytes: &mut &[u8]) -> Result<[u8; N], String> {
    take(bytes, N)?.try_into().map_err(|_| truncated())
}

fn take<'a>(bytes: &mut &'a [u8], len: usize) -> Result<&'a [u8], String> {
    let (taken, rest) = bytes.split_at_checked(len).ok_or_else(truncated)?;
    *bytes = rest;
    Ok(taken)
}

fn truncated() -> String {
    "it is truncated".to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fields_are_read_in_order() {
        let message = [0x08, 0x96, 0x01, 0x12, 0x02, b'h', b'i', 0x1d, 0, 0, 0x80, 0x3f];
        let found = fields(&message).expect("a message");
        assert_eq!(found[0], (1, Value::Varint(150)));
        assert_eq!(found[1].1.text().expect("a text"), "hi");
        let mut floats = Vec::new();
        found[2].1.floats(&mut floats).expect("a float");
        assert_eq!(floats, [1.0]);
    }

    #[test]
    fn truncated_messages_are_errors() {
        let message = [0x08, 0x96, 0x01, 0x12, 0x02, b'h', b'i'];
        for len in [1, 2, 4, 5, 6] {
            assert!(fields(&message[..len]).is_err(), "{len} bytes");
        }
        assert!(fields(&[0xff; 20]).is_err());
    }
}
