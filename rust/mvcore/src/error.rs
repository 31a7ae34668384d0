//! The one error type. A panic is a bug; a wrong argument is an [`Error`].

/// What a kernel reports instead of computing.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Error {
    /// An argument does not fit its contract, e.g. `planes: expected at least 2 values, got 1`.
    #[error("{argument}: expected {expected}, got {got}")]
    InvalidInput {
        /// Name of the argument as the caller wrote it.
        argument: &'static str,
        /// What the contract asks for.
        expected: String,
        /// What came instead.
        got: String,
    },
    /// The result would not fit into the memory the caller allows, e.g. a volume of too many blocks.
    #[error("{what} needs {needed} bytes, more than the allowed {allowed}")]
    OutOfMemory {
        /// What was to be allocated.
        what: &'static str,
        /// Bytes it would take.
        needed: usize,
        /// Bytes the caller allows.
        allowed: usize,
    },
    /// A file could not be read, e.g. a malformed OBJ.
    #[error("{path}: {reason}")]
    File {
        /// The file's path.
        path: String,
        /// Why it could not be read.
        reason: String,
    },
    /// The caller ended the kernel before it was done ([`crate::interrupt`]).
    #[error("interrupted")]
    Interrupted,
    /// A kernel panicked: a bug of its own.
    #[error("internal error, please report it: {message}")]
    Internal {
        /// The panic's message.
        message: String,
    },
}

/// Shorthand of every kernel's return type.
pub type Result<T> = std::result::Result<T, Error>;

/// An [`Error::InvalidInput`] with its three parts.
pub fn invalid<T>(argument: &'static str, expected: impl Into<String>, got: impl std::fmt::Display) -> Result<T> {
    Err(Error::InvalidInput { argument, expected: expected.into(), got: got.to_string() })
}

/// Fails unless `condition` holds.
pub fn require(
    condition: bool,
    argument: &'static str,
    expected: impl Into<String>,
    got: impl std::fmt::Display,
) -> Result<()> {
    if condition { Ok(()) } else { invalid(argument, expected, got) }
}
