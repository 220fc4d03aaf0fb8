//! Errors as they travel: a code for programs, words for people.

use std::fmt;

use serde::{Deserialize, Serialize};

use crate::PROTOCOL;

/// What kind of error it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ErrorCode {
    /// The request's protocol version is not spoken here.
    Version,
    /// The bytes are not the message that the key asks for.
    Malformed,
    /// Nothing is answered at this key.
    UnknownKey,
    /// An array has the wrong number of entries.
    BadShape,
    /// A number is NaN or infinite.
    NotFinite,
    /// A value is outside what is allowed.
    OutOfRange,
    /// The server does not host that many more environments.
    TooManyEnvs,
    /// The lease never existed, was closed, or its grace has passed.
    LeaseLost,
    /// Somebody reclaimed the lease: this epoch is over.
    StaleEpoch,
    /// The sequence number is older than the last one executed.
    StaleSequence,
    /// The sequence number skips at least one.
    SequenceGap,
    /// The environment must be reset first.
    NeedsReset,
    /// The simulation of an environment gave numbers that are not finite.
    Diverged,
    /// The client's spec hash is not this server's.
    SpecMismatch,
    /// Too many requests wait; ask again.
    Busy,
    /// The server is shutting down.
    ShuttingDown,
    /// The server failed; its log says more.
    Internal,
}

impl ErrorCode {
    /// Every code.
    pub const ALL: [ErrorCode; 17] = [
        ErrorCode::Version,
        ErrorCode::Malformed,
        ErrorCode::UnknownKey,
        ErrorCode::BadShape,
        ErrorCode::NotFinite,
        ErrorCode::OutOfRange,
        ErrorCode::TooManyEnvs,
        ErrorCode::LeaseLost,
        ErrorCode::StaleEpoch,
        ErrorCode::StaleSequence,
        ErrorCode::SequenceGap,
        ErrorCode::NeedsReset,
        ErrorCode::Diverged,
        ErrorCode::SpecMismatch,
        ErrorCode::Busy,
        ErrorCode::ShuttingDown,
        ErrorCode::Internal,
    ];

    /// True if the request had effects, so that its sequence number is used up; false if the number is still free.
    pub fn consumes_seq(self) -> bool {
        matches!(self, ErrorCode::Diverged | ErrorCode::Internal)
    }
}

/// An error reply.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, thiserror::Error)]
pub struct ErrorReply {
    /// Protocol version of the sender.
    pub protocol: u16,
    /// What kind of error it is.
    pub code: ErrorCode,
    /// The field or key at fault; empty if it is none.
    pub field: String,
    /// What was wrong: value and what is allowed.
    pub message: String,
    /// How to mend it; may be empty.
    pub hint: String,
    /// True if the same request may succeed later.
    pub retryable: bool,
}

impl ErrorReply {
    /// An error that repeating does not mend.
    pub fn new(code: ErrorCode, field: impl Into<String>, message: impl Into<String>) -> Self {
        Self {
            protocol: PROTOCOL,
            code,
            field: field.into(),
            message: message.into(),
            hint: String::new(),
            retryable: matches!(code, ErrorCode::Busy),
        }
    }

    /// The same error with advice.
    pub fn with_hint(mut self, hint: impl Into<String>) -> Self {
        self.hint = hint.into();
        self
    }

    /// The answer to a request of the protocol version `theirs`.
    pub fn version(theirs: u16) -> Self {
        Self::new(ErrorCode::Version, "protocol", format!("`protocol` = {theirs} is not spoken here; {PROTOCOL} is"))
            .with_hint("install the same Twinstep on both ends; `hello` tells what the server speaks")
    }
}

impl fmt::Display for ErrorReply {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(&self.message)?;
        if !self.hint.is_empty() {
            write!(formatter, "\n  {}", self.hint)?;
        }
        Ok(())
    }
}
