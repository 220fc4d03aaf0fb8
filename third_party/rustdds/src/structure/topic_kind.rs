use std::fmt;

use speedy::{Readable, Writable};

/// Type for DDS Topic (With Key or No key)
#[derive(Debug, Clone, Copy, PartialEq, Eq, Readable, Writable)]
#[repr(u32)]
pub enum TopicKind {
  NoKey = 1,
  WithKey = 2,
}

impl fmt::Display for TopicKind {
  fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
    write!(
      f,
      "{}",
      match self {
        TopicKind::NoKey => "NoKey",
        TopicKind::WithKey => "WithKey",
      }
    )
  }
}

