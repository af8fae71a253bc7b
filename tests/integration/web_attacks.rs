//! Web servers of the program under attack: clients that send nothing, garbage or too much, or never read.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::time::{Duration, Instant};

use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};

use crate::support::page::Server;
use crate::support::place::Place;
use crate::support::process::{Process, wait_until};
use crate::support::service::{reset, step};

/// Idle clients, each with an open connection.
const IDLE: usize = 1200;

/// The connections that a server keeps.
const MAX_CONNECTIONS: usize = 64;

/// Lets this process have the connections of [`IDLE`] clients.
fn raise_descriptors() {
    let limit = getrlimit(Resource::Nofile);
    setrlimit(Resource::Nofile, Rlimit { current: limit.maximum.map(|most| most.min(8192)), ..limit }).unwrap();
}

/// Threads and open descriptors of a process.
fn used(process: &Process) -> (usize, usize) {
    let count = |folder| std::fs::read_dir(format!("/proc/{}/{folder}", process.id())).unwrap().count();
    (count("task"), count("fd"))
}

/// Bytes of a process in memory.
fn resident(process: &Process) -> usize {
    let pages = std::fs::read_to_string(format!("/proc/{}/statm", process.id())).unwrap();
    pages.split(' ').nth(1).unwrap().parse::<usize>().unwrap() * rustix::param::page_size()
}

/// Sends bytes. The server may close the connection before it has read all of them.
fn send(address: SocketAddr, bytes: &[u8]) -> TcpStream {
    let mut stream = TcpStream::connect(address).unwrap();
    stream.set_read_timeout(Some(Duration::from_secs(30))).unwrap();
    let _ = stream.write_all(bytes);
    stream
}

/// Sends a request and returns the answer's first line.
fn answer(address: SocketAddr, request: &str) -> String {
    let mut line = String::new();
    BufReader::new(send(address, request.as_bytes())).read_line(&mut line).unwrap();
    line.trim().to_owned()
}

/// Bytes that are no request, the same in every run.
fn noise() -> Vec<u8> {
    (0..4000_u32).map(|number| (number.wrapping_mul(2_654_435_761) >> 24) as u8).collect()
}

/// Malformed requests, by many clients.
fn attack(address: SocketAddr) {
    let binary = noise();
    let body = [b"POST /metrics HTTP/1.1\r\nContent-Length: 1000000000\r\n\r\n".as_slice(), &binary].concat();
    let chunk = b"POST /metrics HTTP/1.1\r\nTransfer-Encoding: chunked\r\n\r\nffffffffffffffff\r\nabc";
    let headers = ["GET /metrics HTTP/1.1\r\n", &"a: b\r\n".repeat(100_000)].concat();
    for request in [&binary, &body, chunk.as_slice(), headers.as_bytes(), &[b'A'; 1_000_000], b"GET /metrics HTT"] {
        let clients: Vec<_> = (0..100).map(|_| send(address, request)).collect();
        drop(clients);
    }
}

#[test]
fn an_engine_with_metrics_spends_nothing_on_idle_and_malformed_clients() {
    raise_descriptors();
    let place = Place::new();
    let arguments = ["serve", "--env=MortarMayhem-Grid-v0", "--num-envs=2", "--threads=1", "--metrics=127.0.0.1:0"];
    let mut server = Server::start(place.endless(&arguments));
    let (engine, address) = (&server.process, server.address());
    let get = |headers: &str| answer(address, &format!("GET /metrics HTTP/1.1\r\n{headers}\r\n"));
    let own = format!("Host: {address}\r\n");
    let mut trainer = place.trainer("endless").unwrap();
    reset(&mut trainer, 0);
    assert_eq!(get(&own), "HTTP/1.1 200 OK");
    let ((threads, descriptors), memory) = (used(engine), resident(engine));

    let idle: Vec<_> = (0..IDLE).map(|_| TcpStream::connect(address).unwrap()).collect();
    attack(address);
    assert_eq!(get(&own), "HTTP/1.1 200 OK");
    step(&mut trainer, 0);
    let now = used(engine);
    assert!(now.0 == threads && now.1 <= descriptors + MAX_CONNECTIONS, "{now:?}, before {threads}, {descriptors}");
    assert!(resident(engine) < memory + 32_000_000, "{} bytes, before {memory}", resident(engine));
    drop(idle);
    wait_until("the connections are closed", || used(engine).1 <= descriptors);

    // Other sites and names.
    let forbidden = "HTTP/1.1 403 Forbidden";
    for headers in ["", "Host: example.org\r\n", "Host: 127.0.0.1:1\r\n"] {
        assert_eq!(get(headers), forbidden, "{headers}");
    }
    for origin in ["http://example.org", "null"] {
        assert_eq!(get(&format!("{own}Origin: {origin}\r\n")), forbidden, "{origin}");
    }
    server.process.interrupt();
}

/// The request that opens the page's WebSocket.
fn upgrade(server: &Server, service: &str) -> String {
    format!(
        "GET /{}/socket?service={service} HTTP/1.1\r\nHost: {}\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n\
         Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: MDAwMDAwMDAwMDAwMDAwMA==\r\n\r\n",
        server.token(),
        server.address()
    )
}

#[test]
fn a_view_observes_a_limited_number_of_engines_and_none_without_a_browser() {
    let place = Place::new();
    let _engine = place.serve(&["--env", "MortarMayhem-Grid-v0", "--num-envs", "2"]);
    let server = Server::start(place.endless(&["view"]));
    assert_eq!(server.status(&format!("/?token={}", server.token()), &[]), 200);
    let (threads, descriptors) = used(&server.process);
    let mut sockets = Vec::new();
    for number in 0..100 {
        let mut stream = send(server.address(), upgrade(&server, &format!("missing-{number}")).as_bytes());
        let mut status = [0; 12];
        stream.read_exact(&mut status).unwrap();
        let is_shown = &status == b"HTTP/1.1 101";
        assert!(is_shown == (number < 32) && (is_shown || &status == b"HTTP/1.1 503"), "{number}");
        sockets.push(stream);
    }
    assert!(used(&server.process).0 <= threads + 32, "{:?}", used(&server.process));
    drop(sockets);
    wait_until("no engine is observed", || {
        let now = used(&server.process);
        now.0 <= threads && now.1 <= descriptors
    });
    server.show("endless").wait(|about| about["state"] == "live");
}

#[test]
fn a_view_shows_an_engine_beside_idle_and_malformed_clients() {
    raise_descriptors();
    let place = Place::new();
    let _engine = place.serve(&["--env", "MortarMayhem-Grid-v0", "--num-envs", "100"]);
    let server = Server::start(place.endless(&["view"]));
    let mut trainer = place.trainer("endless").unwrap();
    reset(&mut trainer, 0);
    let mut socket = server.show("endless");
    socket.wait(|about| about["state"] == "live");
    let (threads, memory) = (used(&server.process).0, resident(&server.process));

    let _idle: Vec<_> = (0..IDLE).map(|_| TcpStream::connect(server.address()).unwrap()).collect();
    attack(server.address());
    let huge_text = [&[0x81, 0xff][..], &(1_u64 << 62).to_be_bytes(), &[0; 4]].concat();
    let unending = [&[0x01, 0xfe, 0x3f, 0xff, 0, 0, 0, 0][..], &[b'['; 0x3fff]].concat();
    let long_ping = [&[0x89, 0xfe, 0x01, 0x00, 0, 0, 0, 0][..], &[0; 256]].concat();
    let malformed = [
        huge_text,                                // a length that no memory has
        [unending.clone(), unending].concat(),    // fragments of a message that is too long
        vec![0x81, 0x02, b'{', b'}'],             // not masked
        vec![0x8b, 0x80, 0, 0, 0, 0],             // an unknown kind
        vec![0x81, 0x82, 0, 0, 0, 0, 0xff, 0xfe], // text that is not UTF-8
        long_ping,
        noise().iter().map(|byte| byte | 0x70).collect(), // reserved bits
    ];
    for (number, frames) in malformed.iter().enumerate() {
        for _ in 0..10 {
            let stream = send(server.address(), &[upgrade(&server, "endless").as_bytes(), frames].concat());
            // The server ends the connection, after frames that it has sent before.
            let (start, mut answer) = (Instant::now(), Vec::new());
            while matches!((&stream).take(1 << 20).read_to_end(&mut answer), Ok(1..)) {
                assert!(start.elapsed() < Duration::from_secs(10), "frames {number} do not end the connection");
            }
            assert!(answer.starts_with(b"HTTP/1.1 101"), "{}", String::from_utf8_lossy(&answer[..12]));
        }
    }
    // Selections of any size, and browsers that do not read what they are shown.
    let deep = [&[0x81, 0xfe, 0x30, 0x00, 0, 0, 0, 0][..], &[b'['; 0x3000]].concat();
    let slow: Vec<_> =
        (0..10).map(|_| send(server.address(), &[upgrade(&server, "endless").as_bytes(), &deep].concat())).collect();
    let start = Instant::now();
    while start.elapsed() < Duration::from_secs(3) {
        let newest = step(&mut trainer, 0).step();
        socket.wait(|about| about["batch"]["step"].as_u64().is_some_and(|step| step >= newest));
    }
    assert_eq!(used(&server.process).0, threads);
    assert!(resident(&server.process) < memory + 64_000_000, "{}, before {memory}", resident(&server.process));
    assert_eq!(server.status(&format!("/?token={}", server.token()), &[]), 200);
    drop(slow);
}

#[test]
fn the_token_is_neither_logged_nor_in_the_process_list() {
    let place = Place::new();
    let mut server = Server::start(place.endless(&["--log", "trace", "view"]));
    server.get(&format!("/?token={}", server.token()), &[]);
    server.show("missing").next();
    for folder in ["cmdline", "environ"] {
        let shown = std::fs::read(format!("/proc/{}/{folder}", server.process.id())).unwrap();
        assert!(!String::from_utf8_lossy(&shown).contains(server.token()), "{folder}");
    }
    server.process.interrupt();
    let logged = server.process.errors();
    assert!(logged.contains("DEBUG") && !logged.contains(server.token()), "{logged}");
}
