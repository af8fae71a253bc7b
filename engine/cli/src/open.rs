//! Opens a page in the user's browser.

use std::ffi::OsString;
use std::io;
use std::process::{Child, Command, Stdio};
use std::thread;

use super::output::print_error;

/// The environment variable that names the browser: commands separated by `:`, in which `%s` stands for the address.
const BROWSER: &str = "BROWSER";

/// The program that opens an address in the desktop's default browser.
const DESKTOP: &str = "xdg-open";

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

fn start(command: &str, url: &str) -> io::Result<Child> {
    let (program, arguments) = words(command, url);
    Command::new(program).args(arguments).stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null()).spawn()
}

/// The program and its arguments, one of which is the address.
fn words(command: &str, url: &str) -> (OsString, Vec<OsString>) {
    let mut words = command.split_whitespace();
    let program = words.next().unwrap_or_default().into();
    let mut arguments: Vec<OsString> = words.map(|word| word.replace("%s", url).into()).collect();
    if !command.contains("%s") {
        arguments.push(url.into());
    }
    (program, arguments)
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_address_replaces_its_placeholder_or_comes_last() {
        let text = |command| {
            let (program, arguments) = words(command, "http://127.0.0.1:1/?a=b&c");
            std::iter::once(program)
                .chain(arguments)
                .map(|word| word.into_string().unwrap())
                .collect::<Vec<_>>()
                .join("|")
        };
        assert_eq!(text("firefox"), "firefox|http://127.0.0.1:1/?a=b&c");
        assert_eq!(text("firefox --new-window %s"), "firefox|--new-window|http://127.0.0.1:1/?a=b&c");
        assert_eq!(text("w3m  --url=%s -t"), "w3m|--url=http://127.0.0.1:1/?a=b&c|-t");
    }
}
