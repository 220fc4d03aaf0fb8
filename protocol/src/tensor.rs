//! Conversions between tensors and bytes: little-endian, C order.

use crate::{ErrorCode, ErrorReply};

const _: () = assert!(cfg!(target_endian = "little"), "tensors are sent in the byte order of memory");

/// Returns the bytes of `values` without copying.
pub fn as_bytes<T: bytemuck::NoUninit>(values: &[T]) -> &[u8] {
    bytemuck::cast_slice(values)
}

/// Returns the bytes of flags, each 0 or 1, without copying.
pub fn flags_as_bytes(flags: &[bool]) -> &[u8] {
    bytemuck::cast_slice(flags)
}

/// Decodes flags; every byte except 0 is true.
pub fn flags_from_bytes(bytes: &[u8]) -> Vec<bool> {
    let mut flags = Vec::new();
    read_flags_into(bytes, &mut flags);
    flags
}

/// Decodes flags into `flags`, which is resized; every byte except 0 is true.
pub fn read_flags_into(bytes: &[u8], flags: &mut Vec<bool>) {
    flags.clear();
    flags.extend(bytes.iter().map(|byte| *byte != 0));
}

/// Decodes numbers into `values`, which is resized. Fails if the number of bytes is not a multiple of the number size.
pub fn read_into<T: bytemuck::AnyBitPattern>(
    bytes: &[u8],
    values: &mut Vec<T>,
    field: &'static str,
) -> Result<(), ErrorReply> {
    let size = size_of::<T>();
    if !bytes.len().is_multiple_of(size) {
        let message = format!("`{field}` has {} bytes, which is not a multiple of {size}", bytes.len());
        return Err(ErrorReply::new(ErrorCode::BadShape, field, message));
    }
    values.clear();
    // A `bin` can start at any offset in a message, so its numbers may be unaligned.
    values.extend(bytes.chunks_exact(size).map(bytemuck::pod_read_unaligned::<T>));
    Ok(())
}

/// Decodes numbers. Fails if the number of bytes is not a multiple of the number size.
pub fn read<T: bytemuck::AnyBitPattern>(bytes: &[u8], field: &'static str) -> Result<Vec<T>, ErrorReply> {
    let mut values = Vec::new();
    read_into(bytes, &mut values, field)?;
    Ok(values)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn decoding_inverts_encoding_at_any_alignment(values: Vec<f32>, offset in 0usize..4) {
            let mut buffer = vec![0; offset];
            buffer.extend_from_slice(as_bytes(&values));
            let read: Vec<f32> = read(&buffer[offset..], "values").expect("whole numbers");
            let bits = |values: &[f32]| values.iter().map(|value| value.to_bits()).collect::<Vec<_>>();
            prop_assert_eq!(bits(&read), bits(&values));
        }
    }

    #[test]
    fn incomplete_number_is_rejected_with_its_field() {
        let error = read::<f32>(&[0; 7], "actions").expect_err("7 bytes");
        assert_eq!(error.message, "`actions` has 7 bytes, which is not a multiple of 4");
    }
}
