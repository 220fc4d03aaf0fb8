//! Error replies: a code for programs, and text for people.

use std::fmt;

use serde::{Deserialize, Serialize};

use crate::version::PROTOCOL;

/// Kind of an error.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ErrorCode {
    /// The server does not support the request's protocol version.
    Version,
    /// The bytes are not the message of this key.
    Malformed,
    /// The key does not exist, or the task has nothing to render.
    UnknownKey,
    /// An array has the wrong number of entries.
    BadShape,
    /// A number is NaN or infinite.
    NotFinite,
    /// A value is outside its range.
    OutOfRange,
    /// The request is larger than the server accepts.
    TooLarge,
    /// Fewer environments are free, or allowed to this client, than requested.
    TooManyEnvs,
    /// The lease was closed or expired, never existed, or its environments failed.
    LeaseLost,
    /// Another client has reclaimed the lease.
    StaleEpoch,
    /// The sequence number was consumed before.
    StaleSequence,
    /// At least one sequence number was skipped.
    SequenceGap,
    /// An environment has no episode and must be reset first.
    NeedsReset,
    /// The server does not hold the policy of this id.
    UnknownPolicy,
    /// A rollout failed after at least one of its steps, whose results are lost.
    RolloutFailed,
    /// The client's spec hash differs from the server's.
    SpecMismatch,
    /// Too many requests are queued; repeat the request later.
    Busy,
    /// The robot is not ready; repeat the request until it is.
    Waiting,
    /// The server is shutting down.
    ShuttingDown,
    /// The server failed; its log contains the reason.
    Internal,
    /// A code of a newer server that this version does not know; [`ErrorReply::message`] says what it means.
    #[serde(other)]
    Unknown,
}

impl ErrorCode {
    /// All error codes of this version.
    pub const ALL: [ErrorCode; 20] = [
        ErrorCode::Version,
        ErrorCode::Malformed,
        ErrorCode::UnknownKey,
        ErrorCode::BadShape,
        ErrorCode::NotFinite,
        ErrorCode::OutOfRange,
        ErrorCode::TooLarge,
        ErrorCode::TooManyEnvs,
        ErrorCode::LeaseLost,
        ErrorCode::StaleEpoch,
        ErrorCode::StaleSequence,
        ErrorCode::SequenceGap,
        ErrorCode::NeedsReset,
        ErrorCode::UnknownPolicy,
        ErrorCode::RolloutFailed,
        ErrorCode::SpecMismatch,
        ErrorCode::Busy,
        ErrorCode::Waiting,
        ErrorCode::ShuttingDown,
        ErrorCode::Internal,
    ];

    /// Returns true if a request with this error had effects and so consumed its sequence number.
    pub fn consumes_seq(self) -> bool {
        matches!(self, ErrorCode::Internal | ErrorCode::RolloutFailed)
    }
}

/// An error reply.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, thiserror::Error)]
pub struct ErrorReply {
    /// Protocol version of the sender.
    pub protocol: u16,
    /// Kind of the error.
    pub code: ErrorCode,
    /// Name of the invalid field; empty if there is none.
    pub field: String,
    /// What is wrong: the value, and what is allowed.
    pub message: String,
    /// How to fix the error; may be empty.
    pub hint: String,
    /// True if the same request may succeed later.
    pub retryable: bool,
}

impl ErrorReply {
    /// Creates an error reply without a hint.
    pub fn new(code: ErrorCode, field: impl Into<String>, message: impl Into<String>) -> Self {
        Self {
            protocol: PROTOCOL,
            code,
            field: field.into(),
            message: message.into(),
            hint: String::new(),
            retryable: matches!(code, ErrorCode::Busy | ErrorCode::Waiting),
        }
    }

    /// Sets the hint.
    pub fn with_hint(mut self, hint: impl Into<String>) -> Self {
        self.hint = hint.into();
        self
    }

    /// Creates the error reply to a request of the unsupported protocol version `theirs`.
    pub fn version(theirs: u16) -> Self {
        Self::new(ErrorCode::Version, "protocol", format!("`protocol` = {theirs} is not supported; {PROTOCOL} is"))
            .with_hint("install the same Twinstep at both ends; `hello` contains the supported versions")
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
