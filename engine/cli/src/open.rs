//! A page in the user's browser.

use std::process::{Command, Stdio};

use super::failure::Failure;

/// Opens an address in the browser that the desktop has chosen, without waiting for it.
pub fn in_browser(url: &str) -> Result<(), Failure> {
    let mut command = Command::new("xdg-open");
    command.arg(url).stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
    let mut child = command.spawn().map_err(|error| {
        format!("--open: xdg-open cannot be run: {error}; leave --open out and open the address yourself")
    })?;
    // Reaps the process.
    std::thread::Builder::new().spawn(move || drop(child.wait()))?;
    Ok(())
}
