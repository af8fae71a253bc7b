//! A web server for the page, which must not depend on the server's features: Python's, as for users.

use std::io::{BufRead, BufReader};
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};

pub struct PageServer {
    process: Child,
    port: u16,
    query: &'static str,
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
        let mut command = Command::new("python3");
        command.arg(concat!(env!("CARGO_MANIFEST_DIR"), "/tests/browser/server.py")).arg(folder);
        let mut process = command.stdout(Stdio::piped()).stderr(Stdio::null()).spawn().expect("python3 starts");
        let mut line = String::new();
        BufReader::new(process.stdout.take().unwrap()).read_line(&mut line).unwrap();
        PageServer { process, port: line.trim().parse().expect("the server prints its port"), query: "" }
    }

    /// Serves `web`, of which `url` is the page of POPGym.
    pub fn popgym() -> Self {
        let mut server = PageServer::start("web");
        server.query = "?popgym";
        server
    }

    /// The address of the page.
    pub fn url(&self) -> String {
        format!("http://127.0.0.1:{}/{}", self.port, self.query)
    }
}

impl Drop for PageServer {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}
