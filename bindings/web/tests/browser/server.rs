//! A minimal web server for the page, which must not depend on the server's features.

use std::io::{BufRead, BufReader, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

pub struct PageServer {
    address: SocketAddr,
    query: &'static str,
    stopped: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl PageServer {
    /// Serves a page that `cargo xtask test --only browser` builds: `web`, or `own/site` with environments of one's own.
    pub fn start(page: &str) -> Self {
        // The pages are next to the folder for temporary test files.
        let folder = PathBuf::from(env!("CARGO_TARGET_TMPDIR")).with_file_name(page);
        assert!(
            folder.join("index.html").exists(),
            "{} is not built; cargo xtask test --only browser",
            folder.display()
        );
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let (address, stopped) = (listener.local_addr().unwrap(), Arc::new(AtomicBool::new(false)));
        let stop = Arc::clone(&stopped);
        let thread = std::thread::spawn(move || {
            for connection in listener.incoming().flatten() {
                if stop.load(Ordering::Relaxed) {
                    return;
                }
                let folder = folder.clone();
                // In a thread, since browsers open connections before they use them, and one must not block the others.
                std::thread::spawn(move || drop(answer(&folder, connection)));
            }
        });
        PageServer { address, query: "", stopped, thread: Some(thread) }
    }

    /// Serves `web`, of which `url` is the page of POPGym.
    pub fn popgym() -> Self {
        let mut server = PageServer::start("web");
        server.query = "?popgym";
        server
    }

    /// The address of the page.
    pub fn url(&self) -> String {
        format!("http://{}/{}", self.address, self.query)
    }
}

impl Drop for PageServer {
    fn drop(&mut self) {
        self.stopped.store(true, Ordering::Relaxed);
        let _ = TcpStream::connect(self.address);
        let _ = self.thread.take().map(JoinHandle::join);
    }
}

/// Answers one request and closes the connection. With `?slow` the answer comes in pieces, so that a browser shows parts of a document.
fn answer(folder: &Path, mut connection: TcpStream) -> std::io::Result<()> {
    let mut lines = BufReader::new(connection.try_clone()?).lines();
    let Some(request) = lines.next().transpose()? else { return Ok(()) };
    for line in lines {
        if line?.is_empty() {
            break;
        }
    }
    let path = request.split(' ').nth(1).unwrap_or("/").trim_start_matches('/');
    let name = path.split(['?', '#']).next().filter(|name| !name.is_empty()).unwrap_or("index.html");
    let kind = match name.rsplit('.').next() {
        Some("html") => "text/html",
        Some("css") => "text/css",
        Some("js") => "text/javascript",
        Some("wasm") => "application/wasm",
        Some("svg") => "image/svg+xml",
        _ => "application/octet-stream",
    };
    // All files of the page are in one folder.
    let file = if name.contains('/') { None } else { std::fs::read(folder.join(name)).ok() };
    let (status, bytes) = file.map_or(("404 Not Found", Vec::new()), |bytes| ("200 OK", bytes));
    let length = bytes.len();
    write!(
        connection,
        "HTTP/1.1 {status}\r\nContent-Type: {kind}\r\nContent-Length: {length}\r\nConnection: close\r\n\r\n"
    )?;
    if !path.contains("?slow") {
        return connection.write_all(&bytes);
    }
    for piece in bytes.chunks(1000) {
        connection.write_all(piece)?;
        std::thread::sleep(Duration::from_millis(60));
    }
    Ok(())
}
