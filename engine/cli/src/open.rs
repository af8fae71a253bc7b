//! Opens a page in the user's browser.

use std::fs::{self, OpenOptions};
use std::hash::{BuildHasher, RandomState};
use std::io::{self, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::thread;

use crate::output::print_error;

/// The environment variable that names the browser: commands separated by `:`, in which `%s` stands for the address.
const BROWSER: &str = "BROWSER";

/// The program that opens an address in the desktop's default browser.
const DESKTOP: &str = "xdg-open";

/// A page that leads to an address, in a file that only this user can read. Dropping it removes the file.
#[derive(Debug)]
pub struct PrivatePage(PathBuf);

impl PrivatePage {
    /// Opens an address that contains a secret. All users can read a browser's arguments in the list of processes, so the browser
    /// is given the name of the page.
    pub fn open(url: &str) -> io::Result<Self> {
        let folder = std::env::var_os("XDG_RUNTIME_DIR").map_or_else(std::env::temp_dir, PathBuf::from);
        // With a name that others cannot foresee, they cannot make a file of this name first.
        let page = PrivatePage(folder.join(format!("endless-{:016x}.html", RandomState::new().hash_one(url))));
        let mut file = OpenOptions::new().write(true).create_new(true).mode(0o600).open(&page.0)?;
        let url = url.replace('&', "&amp;");
        writeln!(
            file,
            "<!doctype html><meta http-equiv=\"refresh\" content=\"0;url={url}\"><a href=\"{url}\">The page</a>"
        )?;
        in_browser(&format!("file://{}", page.0.display()));
        Ok(page)
    }
}

impl Drop for PrivatePage {
    fn drop(&mut self) {
        let _ = fs::remove_file(&self.0);
    }
}

/// Opens an address in a browser without waiting for it. A failure is only printed, since the page is served anyway.
pub fn in_browser(url: &str) {
    let commands = std::env::var(BROWSER).unwrap_or_default();
    let commands = commands.split(':').filter(|command| !command.trim().is_empty()).chain([DESKTOP]);
    let mut failures = Vec::new();
    for command in commands {
        match start(command, url) {
            Ok(child) => return report_end(command.to_owned(), child),
            Err(error) => failures.push(format!("`{command}`: {error}")),
        }
    }
    print_error(format_args!("--open found no browser ({}); open the address yourself", failures.join(", ")));
}

/// Starts a browser; the address replaces its placeholders or is the last argument.
fn start(command: &str, url: &str) -> io::Result<Child> {
    let mut words = command.split_whitespace();
    let mut browser = Command::new(words.next().unwrap_or_default());
    browser.args(words.map(|word| word.replace("%s", url)));
    if !command.contains("%s") {
        browser.arg(url);
    }
    browser.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null()).spawn()
}

/// Reaps the process and reports its failure: `xdg-open` fails where there is no desktop.
fn report_end(command: String, mut child: Child) {
    let wait = move || match child.wait() {
        Ok(status) if !status.success() => {
            print_error(format_args!("--open: `{command}` failed ({status}); open the address yourself"));
        }
        _ => {}
    };
    // Without a thread, the process is reaped when this one ends.
    let _ = thread::Builder::new().name("browser".to_owned()).spawn(wait);
}
