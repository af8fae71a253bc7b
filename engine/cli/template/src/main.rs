//! All commands of `endless`, with the environments of this crate.

use std::process::ExitCode;

use endless_gym::pool::RegistryError;

fn main() -> Result<ExitCode, RegistryError> {
    Ok(endless_gym::program(&t_maze::registry()?))
}
