//! `endless view`: shows a running engine, on a page served on this machine or in the terminal.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{self, JoinHandle};

use endless_gym_service::Namespace;
use endless_gym_view::ViewServer;

use crate::failure::Failure;
use crate::open::PrivatePage;
use crate::output::{print, print_error};
use crate::stop;
use crate::terminal;

/// Arguments of `endless view`.
///
/// The view is an observer, for which the training does not wait. Ctrl-C ends it; in the terminal, so do Q and Esc.
#[derive(clap::Args)]
pub struct Args {
    /// Name of the engine; the page can be opened before it starts [default: the page lists the running engines; in the
    /// terminal, the only running engine, or `endless`].
    service: Option<String>,
    #[command(flatten)]
    page: PageArgs,
    #[command(flatten)]
    terminal: terminal::view::TerminalArgs,
    /// For a server that is a child process: stop when standard input closes or delivers a byte. With the id of the
    /// parent process, also stop when that process ends.
    #[arg(long, value_name = "PARENT", num_args = 0..=1, require_equals = true, hide = true)]
    #[expect(clippy::option_option, reason = "clap's form of an option with an optional value")]
    child: Option<Option<u32>>,
}

/// Where to serve a page.
#[derive(clap::Args)]
pub struct PageArgs {
    /// Port on 127.0.0.1; 0 takes any free port.
    #[arg(long, default_value_t = 0, conflicts_with = "terminal")]
    pub port: u16,
    /// Open the page in the browser that the variable BROWSER names, or the desktop [default: print the address].
    #[arg(long, conflicts_with = "terminal")]
    pub open: bool,
}

/// Runs `endless view`, until a signal stops it.
pub fn run(args: &Args) -> Result<(), Failure> {
    if args.terminal.terminal {
        return terminal::view::run(args.service.as_deref(), &args.terminal);
    }
    let stop = stop::on_signal()?;
    if let Some(parent) = args.child {
        stop::with_parent(stop, parent)?;
    }
    let (server, _page) = announce(args.service.as_deref(), args.page.port, args.page.open)?;
    if args.child.is_none() {
        print("stop with Ctrl-C")?;
    }
    Ok(server.run(stop)?)
}

/// Binds the port, prints the address, which contains the token, and opens it if wished.
fn announce(service: Option<&str>, port: u16, open: bool) -> Result<(ViewServer, Option<PrivatePage>), Failure> {
    let server = ViewServer::bind(port, Namespace::default(), service)?;
    let url = server.url();
    print(format_args!("view {} at {url}", service.unwrap_or("the running engines")))?;
    let page = open.then(|| PrivatePage::open(&url)).transpose()?;
    Ok((server, page))
}

/// A page served in a background thread, until this is dropped.
pub struct Beside {
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
    _page: Option<PrivatePage>,
}

impl Beside {
    /// Shows an engine on any free port, and prints the address.
    pub fn start(service: &str, open: bool) -> Result<Self, Failure> {
        let (server, page) = announce(Some(service), 0, open)?;
        let stop = Arc::new(AtomicBool::new(false));
        let flag = Arc::clone(&stop);
        let serve = move || {
            if let Err(error) = server.run(&flag) {
                print_error(&error);
            }
        };
        let thread = thread::Builder::new().name("view".to_owned()).spawn(serve)?;
        Ok(Beside { stop, thread: Some(thread), _page: page })
    }
}

impl Drop for Beside {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        // A panic of the thread has already been printed.
        let _ = self.thread.take().map(JoinHandle::join);
    }
}
