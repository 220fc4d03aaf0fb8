//! Who receives the progress of a verb, and may end it.

use std::fmt::Display;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use indicatif::{ProgressBar, ProgressDrawTarget};

use crate::failure::Failure;
use crate::progress_lines;
use crate::signals::Signals;

/// Receives progress and notes of a verb, and can interrupt it.
pub struct Observer {
    signals: Signals,
    is_silent: bool,
}

impl Observer {
    /// Returns an observer that shows nothing and never interrupts: for use as a library.
    pub fn silent() -> Self {
        Self { signals: Signals::none(), is_silent: true }
    }

    /// Returns an observer that shows progress and notes on stderr. SIGINT and SIGTERM interrupt the verb.
    pub fn terminal() -> Result<Self, Failure> {
        Ok(Self { signals: Signals::listen()?, is_silent: false })
    }

    /// Returns `Err(Interrupted)` after a SIGINT, `Ok(true)` after a SIGTERM, and `Ok(false)` before either.
    pub fn check(&self) -> Result<bool, Failure> {
        self.signals.check()
    }

    /// Returns a flag that is true after either signal.
    pub fn flag(&self) -> Arc<AtomicBool> {
        self.signals.flag()
    }

    /// Returns true if nothing is shown.
    pub fn is_silent(&self) -> bool {
        self.is_silent
    }

    /// Shows a line.
    pub fn note(&self, text: impl Display) {
        if !self.is_silent {
            eprintln!("{text}");
        }
    }

    /// Returns a progress bar of this length in the style of a template of `indicatif`.
    pub fn bar(&self, length: u64, template: &str) -> ProgressBar {
        self.styled(ProgressBar::new(length), template)
    }

    /// Returns a spinner in the style of a template of `indicatif`.
    pub fn spinner(&self, template: &str) -> ProgressBar {
        self.styled(ProgressBar::new_spinner(), template)
    }

    fn styled(&self, bar: ProgressBar, template: &str) -> ProgressBar {
        bar.set_draw_target(if self.is_silent { ProgressDrawTarget::hidden() } else { progress_lines::target() });
        bar.with_style(progress_lines::style(template))
    }
}
