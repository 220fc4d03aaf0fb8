//! Messages in the format of Protocol Buffers.

/// A message under construction.
#[derive(Clone, Debug, Default)]
pub struct Message(Vec<u8>);

impl Message {
    /// Returns the bytes.
    pub fn into_bytes(self) -> Vec<u8> {
        self.0
    }

    /// Appends a field with a text.
    pub fn text(self, field: u32, text: &str) -> Self {
        self.bytes(field, text.as_bytes())
    }

    /// Appends a field with another message.
    pub fn message(self, field: u32, message: Self) -> Self {
        self.bytes(field, &message.0)
    }

    /// Appends a field with an integer or a truth value.
    pub fn integer(mut self, field: u32, value: u64) -> Self {
        self.varint(u64::from(field) << 3);
        self.varint(value);
        self
    }

    /// Appends fields with numbers, the first of them being 1.
    pub fn numbers(mut self, values: impl IntoIterator<Item = f64>) -> Self {
        for (field, value) in (1..).zip(values) {
            self.number(field, value);
        }
        self
    }

    /// Appends a field with a number.
    pub fn with_number(mut self, field: u32, value: f64) -> Self {
        self.number(field, value);
        self
    }

    /// Appends a packed field with integers of 32 bits.
    pub fn fixed32s(self, field: u32, values: &[u32]) -> Self {
        self.bytes(field, &values.iter().flat_map(|value| value.to_le_bytes()).collect::<Vec<u8>>())
    }

    fn number(&mut self, field: u32, value: f64) {
        self.varint((u64::from(field) << 3) | 1);
        self.0.extend(value.to_le_bytes());
    }

    fn bytes(mut self, field: u32, bytes: &[u8]) -> Self {
        self.varint((u64::from(field) << 3) | 2);
        self.varint(bytes.len() as u64);
        self.0.extend(bytes);
        self
    }

    fn varint(&mut self, mut value: u64) {
        while value >= 0x80 {
            self.0.push(value as u8 | 0x80);
            value >>= 7;
        }
        self.0.push(value as u8);
    }
}
