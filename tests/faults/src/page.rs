//! A page that shows the engine: the server of `endless view`, and a client that stands in for the browser.

use std::net::TcpStream;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use endless_gym_core::random::Generator;
use endless_gym_service::Namespace;
use endless_gym_view::ViewServer;
use serde_json::json;
use tungstenite::{Error, Message};

use crate::event::Event;
use crate::others::stop_at_end_of_input;
use crate::shape::SERVICE;

/// How long the client waits for a message before it selects other environments.
const PATIENCE: Duration = Duration::from_millis(400);

/// Serves the page until standard input ends, and shows it in one browser after the other.
pub fn show() -> Result<(), String> {
    let stop = stop_at_end_of_input();
    let server = ViewServer::bind(0, Namespace::default(), Some(SERVICE)).map_err(|error| error.to_string())?;
    let url = server.url();
    let (address, token) = url
        .strip_prefix("http://")
        .and_then(|url| url.split_once("/?token="))
        .ok_or_else(|| format!("the address {url} has no token"))?;
    let (address, token, flag) = (address.to_owned(), token.to_owned(), Arc::clone(&stop));
    let client = std::thread::spawn(move || {
        let mut draws = Generator::from_seed(1);
        while !flag.load(Ordering::Relaxed) {
            let shown = browse(&address, &token, &mut draws, &flag).map_err(|error| error.to_string())?;
            Event::Shown { messages: shown }.report();
        }
        Ok(())
    });
    server.run(&stop).map_err(|error| error.to_string())?;
    let result = client.join().map_err(|_| "the client panicked")?;
    // The server ends the client's connection.
    if stop.load(Ordering::Relaxed) { Ok(()) } else { result }
}

/// Shows some messages, each of a random selection of environments, and returns their number.
fn browse(address: &str, token: &str, draws: &mut Generator, stop: &AtomicBool) -> Result<u64, Error> {
    let stream = TcpStream::connect(address)?;
    stream.set_read_timeout(Some(PATIENCE))?;
    let url = format!("ws://{address}/{token}/socket?service={SERVICE}");
    let (mut socket, _) = tungstenite::client(url, stream).map_err(|error| Error::Io(std::io::Error::other(error)))?;
    let mut shown = 0;
    for _ in 0..draws.integers(1, 100) {
        if stop.load(Ordering::Relaxed) {
            break;
        }
        if draws.integers(0, 5) == 0 {
            let envs: Vec<_> = (0..draws.integers(0, 6)).map(|_| draws.integers(0, 20)).collect();
            let selection = json!({"group": draws.integers(0, 4), "envs": envs});
            socket.send(Message::text(selection.to_string()))?;
        }
        match socket.read() {
            Ok(message) => shown += u64::from(message.is_binary()),
            Err(Error::Io(error)) if error.kind() == std::io::ErrorKind::WouldBlock => {}
            Err(error) => return Err(error),
        }
    }
    Ok(shown)
}
