//! A terminal of which nothing is read: its keys are for another thread.

use std::io::Write;

use ratatui::backend::{Backend, ClearType, TermionBackend, WindowSize};
use ratatui::buffer::Cell;
use ratatui::layout::{Position, Size};

/// The backend of termion, except that nobody asks the terminal for its cursor. The answer would come among the keys: the thread that
/// waits for it would swallow keys, also a stop, and end with a panic if a key is not what it expects.
pub struct WriteOnlyBackend<W: Write>(TermionBackend<W>);

impl<W: Write> WriteOnlyBackend<W> {
    /// Creates a backend that writes to `writer`.
    pub fn new(writer: W) -> Self {
        Self(TermionBackend::new(writer))
    }
}

impl<W: Write> Backend for WriteOnlyBackend<W> {
    type Error = std::io::Error;

    fn draw<'a, I>(&mut self, content: I) -> std::io::Result<()>
    where
        I: Iterator<Item = (u16, u16, &'a Cell)>,
    {
        self.0.draw(content)
    }

    fn hide_cursor(&mut self) -> std::io::Result<()> {
        self.0.hide_cursor()
    }

    fn show_cursor(&mut self) -> std::io::Result<()> {
        self.0.show_cursor()
    }

    fn get_cursor_position(&mut self) -> std::io::Result<Position> {
        Ok(Position::ORIGIN)
    }

    fn set_cursor_position<P: Into<Position>>(&mut self, position: P) -> std::io::Result<()> {
        self.0.set_cursor_position(position)
    }

    fn clear(&mut self) -> std::io::Result<()> {
        self.0.clear()
    }

    fn clear_region(&mut self, clear_type: ClearType) -> std::io::Result<()> {
        self.0.clear_region(clear_type)
    }

    fn size(&self) -> std::io::Result<Size> {
        self.0.size()
    }

    fn window_size(&mut self) -> std::io::Result<WindowSize> {
        self.0.window_size()
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Backend::flush(&mut self.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_is_asked_of_the_terminal() {
        let mut written = Vec::new();
        {
            let mut backend = WriteOnlyBackend::new(&mut written);
            // `Terminal::clear` keeps the cursor where it was.
            let cursor = backend.get_cursor_position().expect("a position");
            backend.set_cursor_position(cursor).expect("written");
        }
        // The question for the position of the cursor is not among it.
        assert_eq!(String::from_utf8(written).as_deref(), Ok("\x1b[1;1H"));
    }
}
