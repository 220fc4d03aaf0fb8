//! Checksum of the robot's messages: CRC-32/MPEG-2 over the words of the C structure.
//!
//! The C structure is another layout than CDR: every structure in it begins and ends at a multiple of four bytes.

use crate::cdr::{FieldVisitor, Message, Primitive};
use crate::{LowCmd, LowState};

/// Generator polynomial of CRC-32/MPEG-2.
const POLYNOMIAL: u32 = 0x04c1_1db7;

/// A message's checksum does not agree with its fields.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("its checksum is {found:#010x}, but that of its fields is {computed:#010x}")]
pub struct ChecksumError {
    /// Checksum in the message.
    pub found: u32,
    /// Checksum of the fields.
    pub computed: u32,
}

/// Words that are taken in at once.
const WORDS: usize = 2;

/// `TABLES[n][byte]`: remainder of a byte that is followed by `n` bytes of zero.
const TABLES: [[u32; 256]; 4 * WORDS] = {
    let mut tables = [[0; 256]; 4 * WORDS];
    let mut byte = 0;
    while byte < 256 {
        let mut remainder = (byte as u32) << 24;
        let mut zeros = 0;
        while zeros < tables.len() {
            let mut bit = 0;
            while bit < 8 {
                remainder = if remainder >> 31 == 1 { (remainder << 1) ^ POLYNOMIAL } else { remainder << 1 };
                bit += 1;
            }
            tables[zeros][byte] = remainder;
            zeros += 1;
        }
        byte += 1;
    }
    tables
};

/// Returns the CRC-32/MPEG-2 of little-endian words; `image` has a multiple of four bytes.
pub fn crc32(image: &[u8]) -> u32 {
    // The tables of several words are looked up independently of each other, which a processor does at the same time.
    let mut blocks = image.chunks_exact(4 * WORDS);
    let crc = blocks.by_ref().fold(u32::MAX, take_in);
    take_in(crc, blocks.remainder())
}

/// Takes in up to [`WORDS`] words.
fn take_in(crc: u32, words: &[u8]) -> u32 {
    let mut carried = crc;
    let mut remainder = 0;
    for (index, word) in words.chunks_exact(4).enumerate() {
        // The most significant byte of a word comes first, which is the last of its four bytes.
        let word = u32::from_le_bytes([word[0], word[1], word[2], word[3]]) ^ std::mem::take(&mut carried);
        let follow = words.len() - 4 * index - 4;
        for (byte, value) in word.to_le_bytes().into_iter().enumerate() {
            remainder ^= TABLES[follow + byte][usize::from(value)];
        }
    }
    // Without words nothing was taken in.
    remainder ^ carried
}

impl LowCmd {
    /// Returns the checksum of the fields.
    pub fn checksum(&self) -> u32 {
        checksum(self)
    }

    /// Returns the message with its checksum.
    pub fn with_checksum(mut self) -> Self {
        self.crc = self.checksum();
        self
    }

    /// Checks that the checksum in the message is that of its fields.
    pub fn check_checksum(&self) -> Result<(), ChecksumError> {
        compare(self.crc, self.checksum())
    }
}

impl LowState {
    /// Returns the checksum of the fields.
    pub fn checksum(&self) -> u32 {
        checksum(self)
    }

    /// Returns the message with its checksum.
    pub fn with_checksum(mut self) -> Self {
        self.crc = self.checksum();
        self
    }

    /// Checks that the checksum in the message is that of its fields.
    pub fn check_checksum(&self) -> Result<(), ChecksumError> {
        compare(self.crc, self.checksum())
    }
}

fn compare(found: u32, computed: u32) -> Result<(), ChecksumError> {
    if found == computed { Ok(()) } else { Err(ChecksumError { found, computed }) }
}

/// Returns the checksum of everything before the last field, which is the checksum.
fn checksum(message: &impl Message) -> u32 {
    let image = c_image(message);
    crc32(&image[..image.len() - size_of::<u32>()])
}

/// Returns the bytes of a message as a C structure on a little-endian machine, with padding of zero.
fn c_image<M: Message>(message: &M) -> Vec<u8> {
    let mut image = CImage(Vec::with_capacity(size_of::<M>()));
    message.clone().visit_fields(&mut image);
    image.0
}

struct CImage(Vec<u8>);

impl CImage {
    fn align(&mut self, alignment: usize) {
        self.0.resize(self.0.len().next_multiple_of(alignment), 0);
    }
}

impl FieldVisitor for CImage {
    fn value<T: Primitive>(&mut self, value: &mut T) {
        self.align(T::SIZE);
        value.append(&mut self.0);
    }

    fn structure(&mut self, structure: &mut impl Message) {
        self.align(align_of::<u32>());
        structure.visit_fields(self);
        self.align(align_of::<u32>());
    }

    // No message with a checksum has fields of variable length.
    fn bytes(&mut self, _: &mut Vec<u8>) {}
    fn string(&mut self, _: &mut String) {}
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::MotorCmd;
    use crate::cdr::distinct;

    /// Command to stand: the first twelve motors have a position, the others none.
    fn standing() -> LowCmd {
        let mut command = LowCmd::stopped();
        for (index, motor) in command.motor_cmd.iter_mut().take(12).enumerate() {
            let q = [0.0, 0.67, -1.3][index % 3];
            *motor = MotorCmd { mode: 1, q, dq: 0.0, tau: 0.0, kp: 60.0, kd: 5.0, ..MotorCmd::default() };
        }
        command
    }

    /// The checksums are those of the vendor's compiled library.
    #[test]
    fn checksums_agree_with_those_of_the_vendor() {
        assert_eq!(LowCmd::default().checksum(), 0x4b5a_4880);
        assert_eq!(LowCmd::stopped().checksum(), 0x06e5_77cd);
        assert_eq!(standing().checksum(), 0x8fe6_977e);
    }

    #[test]
    fn image_is_that_of_the_c_structure() {
        let command = distinct::<LowCmd>(808);
        let image = c_image(&command);
        assert_eq!(image.len(), 812);
        for (index, motor) in command.motor_cmd.iter().enumerate() {
            let start = 24 + 36 * index;
            assert_eq!(image[start], motor.mode);
            assert_eq!(image[start + 4..start + 8], motor.q.to_le_bytes());
            assert_eq!(image[start + 32..start + 36], motor.reserve[2].to_le_bytes());
        }
        assert_eq!(image[744], command.bms_cmd.off);
        assert_eq!(image[748..788], command.wireless_remote.0);
        assert_eq!(image[788..800], command.led);
        assert_eq!((image[800], image[802]), (command.fan[0], command.gpio));
        assert_eq!(image[804..808], command.reserve.to_le_bytes());
        assert_eq!(image[808..812], command.crc.to_le_bytes());
        assert_eq!(c_image(&LowState::default()).len(), 1180);
    }

    #[test]
    fn any_number_of_words_has_the_remainder_of_the_polynomial_division() {
        let image: Vec<u8> = (0..44_u32).map(|index| (index * index * 37 + 11) as u8).collect();
        for len in (0..=image.len()).step_by(4) {
            let words =
                image[..len].chunks_exact(4).map(|word| u32::from_le_bytes(word.try_into().expect("four bytes")));
            let divided = words.fold(u32::MAX, |crc, word| {
                (0..32).fold(crc ^ word, |crc, _| if crc >> 31 == 1 { (crc << 1) ^ POLYNOMIAL } else { crc << 1 })
            });
            assert_eq!(crc32(&image[..len]), divided, "{len} bytes");
        }
    }

    #[test]
    fn every_flipped_bit_is_detected() {
        let image = c_image(&standing());
        let expected = crc32(&image[..808]);
        for bit in 0..808 * 8 {
            let mut image = image.clone();
            image[bit / 8] ^= 1 << (bit % 8);
            assert_ne!(crc32(&image[..808]), expected, "bit {bit}");
        }
    }

    #[test]
    fn wrong_checksum_is_named_with_the_right_one() {
        let mut command = standing().with_checksum();
        assert_eq!(command.check_checksum(), Ok(()));
        command.motor_cmd[3].kp = 61.0;
        let computed = command.checksum();
        assert_eq!(command.check_checksum(), Err(ChecksumError { found: 0x8fe6_977e, computed }));
        let mut state = distinct::<LowState>(1176).with_checksum();
        assert_eq!(state.check_checksum(), Ok(()));
        state.motor_state[7].q *= -1.0;
        assert!(state.check_checksum().is_err());
    }
}
