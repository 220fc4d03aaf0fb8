//! The terminal as a source of single keys.

use std::io::{Read, stdin};

use rustix::termios::{InputModes, LocalModes, OptionalActions, SpecialCodeIndex, Termios, tcgetattr, tcsetattr};

/// Terminal that does not wait for whole lines and does not show the keys, until the value is dropped.
pub struct KeyTerminal(Termios);

impl KeyTerminal {
    /// Changes the modes of this process's terminal.
    pub fn open() -> rustix::io::Result<Self> {
        let before = tcgetattr(stdin())?;
        let mut modes = before.clone();
        // Ctrl-C stays a signal.
        modes.local_modes -= LocalModes::ICANON | LocalModes::ECHO;
        // Ctrl-S must not stop what is shown: nobody would see that it does.
        modes.input_modes -= InputModes::IXON;
        // A read returns after 0.1 s without a key.
        modes.special_codes[SpecialCodeIndex::VMIN] = 0;
        modes.special_codes[SpecialCodeIndex::VTIME] = 1;
        tcsetattr(stdin(), OptionalActions::Now, &modes)?;
        Ok(Self(before))
    }

    /// Returns the bytes of the keys that are pressed within 0.1 s.
    #[expect(clippy::unused_self, reason = "the terminal sends single keys only while the value exists")]
    pub fn read<'a>(&self, bytes: &'a mut [u8]) -> std::io::Result<&'a [u8]> {
        match stdin().lock().read(bytes) {
            Ok(len) => Ok(&bytes[..len]),
            Err(error) if error.kind() == std::io::ErrorKind::Interrupted => Ok(&[]),
            Err(error) => Err(error),
        }
    }
}

impl KeyTerminal {
    /// Gives the terminal its modes back.
    pub fn close(&self) {
        // Nothing is left to do if it fails.
        let _ = tcsetattr(stdin(), OptionalActions::Now, &self.0);
    }
}

impl Drop for KeyTerminal {
    fn drop(&mut self) {
        self.close();
    }
}
