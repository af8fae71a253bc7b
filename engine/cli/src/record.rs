//! `endless record`. The Python package's program runs it itself, since Python's libraries write the data sets.

use std::ffi::OsString;

use super::failure::Failure;

/// Arguments of `endless record`, which Python reads.
#[derive(clap::Args)]
pub struct Args {
    #[arg(trailing_var_arg = true, allow_hyphen_values = true, hide = true)]
    _arguments: Vec<OsString>,
}

/// Says how to run `endless record`.
pub fn run() -> Failure {
    "`record` is a command of the Python package's program `endless`, and its first argument: \
     pip install './bindings/python[minari]', or the wheel file with `[minari]` appended"
        .into()
}
