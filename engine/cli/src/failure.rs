//! Errors of commands.

/// The error of a command. The program prints it as one line.
pub type Failure = Box<dyn std::error::Error>;
