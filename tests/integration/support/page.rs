//! The web servers of the program `endless` as real processes, and clients for them.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use serde_json::{Value as Json, json};
use tungstenite::client::IntoClientRequest;
use tungstenite::{Message, WebSocket};

use super::process::{Process, wait_until};

/// How long anything may take; the machine may be busy with other tests.
const PATIENCE: Duration = Duration::from_secs(60);

/// A script that stands in for a browser: it writes its arguments to a file, which appears complete.
pub const BROWSER: &str = "echo \"$@\" > \"$0.part\"; mv \"$0.part\" \"$0.given\"";

/// Waits until such a browser is started, and returns its arguments. It can be called again for the next start.
pub fn given(browser: &Path) -> String {
    let file = PathBuf::from(format!("{}.given", browser.display()));
    wait_until("the browser is started", || file.exists());
    let text = std::fs::read_to_string(&file).unwrap();
    std::fs::remove_file(&file).unwrap();
    text.trim().to_owned()
}

/// A server process.
pub struct Server {
    pub process: Process,
    /// The address that it has printed.
    pub url: String,
}

impl Server {
    pub fn start(mut command: Command) -> Self {
        let mut process = Process::spawn(command.stdout(Stdio::piped()).stderr(Stdio::piped()));
        let mut lines = BufReader::new(process.0.stdout.take().unwrap()).lines().map_while(Result::ok);
        let url = lines.find_map(|line| line.split(' ').find(|word| word.starts_with("http://")).map(str::to_owned));
        // Drain later output, so that the process does not block.
        std::thread::spawn(move || lines.for_each(drop));
        let url = url.unwrap_or_else(|| panic!("no address: {}", process.errors()));
        Server { process, url }
    }

    pub fn address(&self) -> SocketAddr {
        let rest = self.url.strip_prefix("http://").unwrap();
        rest.split('/').next().unwrap().parse().unwrap()
    }

    pub fn token(&self) -> &str {
        self.url.split("token=").nth(1).unwrap()
    }

    /// Requests a path as a browser would, with additional headers, and returns status, headers and body.
    pub fn get(&self, path: &str, headers: &[(&str, &str)]) -> (u16, String, Vec<u8>) {
        let host = self.address().to_string();
        let mut all = vec![("Host", &*host), ("Connection", "close")];
        for (name, value) in headers {
            all.retain(|(other, _)| other != name);
            all.push((name, value));
        }
        let headers: String = all.iter().map(|(name, value)| format!("{name}: {value}\r\n")).collect();
        let mut stream = TcpStream::connect(self.address()).unwrap();
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        write!(stream, "GET {path} HTTP/1.1\r\n{headers}\r\n").unwrap();
        let mut answer = Vec::new();
        stream.read_to_end(&mut answer).unwrap();
        let end = answer.windows(4).position(|four| four == b"\r\n\r\n").expect("an answer has headers");
        let head = String::from_utf8(answer[..end].to_vec()).unwrap();
        let status = head.split(' ').nth(1).unwrap().parse().unwrap();
        (status, head, answer[end + 4..].to_vec())
    }

    pub fn status(&self, path: &str, headers: &[(&str, &str)]) -> u16 {
        self.get(path, headers).0
    }

    /// A browser's connection that shows an engine.
    pub fn show(&self, service: &str) -> Socket {
        let address = format!("ws://{}/{}/socket?service={service}", self.address(), self.token());
        let stream = TcpStream::connect(self.address()).unwrap();
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        let (socket, _) = tungstenite::client(address.into_client_request().unwrap(), stream).unwrap();
        Socket { socket }
    }
}

/// A browser's connection.
pub struct Socket {
    socket: WebSocket<TcpStream>,
}

impl Socket {
    /// The next message with frames: its JSON and the pixels.
    pub fn next(&mut self) -> (Json, Vec<u8>) {
        loop {
            if let Message::Binary(bytes) = self.socket.read().unwrap() {
                let length = u32::from_le_bytes(bytes[..4].try_into().unwrap()) as usize;
                return (serde_json::from_slice(&bytes[4..4 + length]).unwrap(), bytes[4 + length..].to_vec());
            }
        }
    }

    /// The next message with points of the curves.
    pub fn points(&mut self) -> Json {
        loop {
            if let Message::Text(text) = self.socket.read().unwrap() {
                return serde_json::from_str(&text).unwrap();
            }
        }
    }

    /// The first message for which a condition holds.
    #[track_caller]
    pub fn wait(&mut self, condition: impl Fn(&Json) -> bool) -> (Json, Vec<u8>) {
        let start = Instant::now();
        loop {
            let message = self.next();
            if condition(&message.0) {
                return message;
            }
            assert!(start.elapsed() < PATIENCE, "the last message: {}", message.0);
        }
    }

    pub fn select(&mut self, group: usize, envs: &[usize]) {
        let text = json!({"group": group, "envs": envs}).to_string();
        self.socket.send(Message::text(text)).unwrap();
    }
}
