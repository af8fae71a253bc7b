//! `endless view`: what a browser receives of a running engine, and who is refused.

mod page_support;
mod program_support;

use std::process::{Child, Stdio};
use std::time::{Duration, Instant};

use endless_gym::batch::{Batch, Frames, PixelFormat, zeroed};
use endless_gym::pool::{Pool, PoolConfig, ResetRequest, Threads};
use endless_gym::service::{EngineStatus, Namespace, Trainer};
use page_support::Server;
use program_support::{Room, signal, wait};
use rustix::process::Signal;
use serde_json::json;

const TIMEOUT: Duration = Duration::from_secs(30);

/// An engine process.
struct Engine(Child);

impl Engine {
    fn start(room: &Room, arguments: &[&str]) -> Self {
        let mut command = room.endless(&[&["serve", "--threads", "1"], arguments].concat());
        let engine = Engine(command.stdout(Stdio::null()).spawn().unwrap());
        room.wait_for_engine();
        engine
    }

    fn end(&mut self) {
        signal(&self.0, Signal::INT);
        wait(&mut self.0);
    }
}

impl Drop for Engine {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn step(trainer: &mut Trainer, group: usize) {
    trainer.send_with(group, |actions| actions.fill(1)).unwrap();
    trainer.receive(group, TIMEOUT).unwrap();
}

fn observers(room: &Room) -> usize {
    let status = EngineStatus::of(&Namespace::at(&room.root), "endless").unwrap();
    status.groups.iter().map(|group| group.observers.len()).sum()
}

fn wait_for_observers(room: &Room, expected: usize) {
    let start = Instant::now();
    while observers(room) != expected {
        assert!(start.elapsed() < TIMEOUT, "{} observers instead of {expected}", observers(room));
        std::thread::sleep(Duration::from_millis(20));
    }
}

#[test]
fn the_token_the_host_and_the_origin_are_required() {
    let room = Room::new("view-token");
    let mut server = Server::start(room.endless(&["view"]));
    let token = server.token().to_owned();
    assert_eq!(token.len(), 32, "{}", server.url);
    let page = format!("/?token={token}");
    let (status, headers, body) = server.get(&page, &[]);
    assert_eq!(status, 200);
    assert!(
        headers.contains("no-store") && headers.contains("no-referrer") && headers.contains("text/html"),
        "{headers}"
    );
    let body = String::from_utf8(body).unwrap();
    // Every file that the page names is there.
    assert!(body.contains(&format!("<base href=\"/{token}/\">")), "{body}");
    for name in ["style.css", "view.css", "icon.svg", "view.js", "frames.js", "curves.js", "engines.js", "numbers.js"] {
        let (status, headers, body) = server.get(&format!("/{token}/{name}"), &[]);
        assert!(status == 200 && !body.is_empty(), "{name}: {headers}");
    }
    let wrong = format!("/?token={}", "0".repeat(32));
    for path in
        ["/", "/?token=", &wrong, "/style.css", "/view.js", "/engines", "/x/engines", "/x/socket?service=endless"]
    {
        assert_eq!(server.status(path, &[]), 403, "{path}");
    }
    for foreign in
        [("Host", "example.org"), ("Host", "localhost"), ("Origin", "http://example.org"), ("Origin", "null")]
    {
        for path in [page.clone(), format!("/{token}/engines"), format!("/{token}/socket?service=endless")] {
            assert_eq!(server.status(&path, &[foreign]), 403, "{foreign:?} {path}");
        }
    }
    let own = format!("http://{}", server.address());
    assert_eq!(server.status(&page, &[("Origin", &own)]), 200);
    for path in ["../Cargo.toml", "../../etc/passwd", "%2e%2e/Cargo.toml", "files/view.js", "view.rs", "index.html", ""]
    {
        assert_eq!(server.status(&format!("/{token}/{path}"), &[]), 404, "{path}");
    }
    // No other interface of the machine is bound.
    assert!(server.address().ip().is_loopback());
    signal(&server.child, Signal::INT);
    assert!(wait(&mut server.child).success());
}

#[test]
fn frames_are_the_batchs_bytes_in_every_layout() {
    let bools = [false, true];
    let formats = bools.into_iter().flat_map(|grayscale| {
        bools.into_iter().flat_map(move |channels_first| {
            bools.map(move |row_major| PixelFormat { grayscale, channels_first, row_major })
        })
    });
    for (number, format) in formats.enumerate() {
        let stack = [1, 3][number % 2];
        let room = Room::new("formats");
        let id = "MysteryPath-Grid-v0";
        let stack_text = stack.to_string();
        let mut arguments = vec!["--env", id, "--num-envs", "5", "--seed", "7", "--frame-stack", &stack_text];
        arguments.extend(format.grayscale.then_some("--grayscale"));
        arguments.extend(format.channels_first.then_some("--channels-first"));
        arguments.extend(format.row_major.then_some("--row-major"));
        let _engine = Engine::start(&room, &arguments);
        let server = Server::start(room.endless(&["view", "endless"]));
        let mut trainer = room.connect("endless");
        let mut socket = server.show("endless");
        let envs = [3, 0, 4];
        socket.select(0, &envs);
        // Observers receive what is sent after they have connected.
        wait_for_observers(&room, 1);

        let config = PoolConfig { frames: Some(Frames { format, stack }), ..PoolConfig::new(id, 5) };
        let mut twin = Pool::new(&config, &Threads::new(1).unwrap()).unwrap();
        let mut blocks = zeroed(twin.layout().blocks());
        trainer.reset(0, ResetRequest::Seed(11)).unwrap();
        trainer.receive(0, TIMEOUT).unwrap();
        twin.reset(ResetRequest::Seed(11), &mut blocks).unwrap();
        for _ in 0..4 {
            step(&mut trainer, 0);
            twin.step(&vec![1; 5 * twin.spec().action_space.branches().len()], &mut blocks).unwrap();
        }
        let (about, pixels) = socket.wait(|about| {
            about["batch"]["step"] == 5 && about["batch"]["envs"].as_array().is_some_and(|shown| shown.len() == 3)
        });
        let batch = Batch::new(twin.layout(), &blocks);
        let width = batch.observation().len() / 5;
        let newest = |env: usize| &batch.observation()[(env + 1) * width - width / stack..(env + 1) * width];
        let expected: Vec<u8> = envs.iter().flat_map(|env| newest(*env)).copied().collect();
        assert!(pixels == expected, "{format:?} {stack}: other pixels");
        assert_eq!(about["batch"]["envs"][0]["env"], 3);
        assert_eq!(about["batch"]["envs"][2]["return"], batch.episode_return()[4]);
        assert_eq!(about["batch"]["envs"][1]["length"], batch.episode_length()[0]);

        // The strides lead to the pixels that the same episode has as [x][y][channel].
        let mut plain = Pool::new(&PoolConfig::new(id, 5), &Threads::new(1).unwrap()).unwrap();
        let mut plain_blocks = zeroed(plain.layout().blocks());
        plain.reset(ResetRequest::Seed(11), &mut plain_blocks).unwrap();
        for _ in 0..4 {
            plain.step(&vec![1; 5 * plain.spec().action_space.branches().len()], &mut plain_blocks).unwrap();
        }
        let colours = Batch::new(plain.layout(), &plain_blocks).observation();
        let frame = &about["batch"]["frame"];
        let number = |name: &str| frame[name].as_u64().unwrap() as usize;
        assert_eq!((number("width"), number("height"), number("stack")), (84, 84, stack));
        assert_eq!(number("channels"), if format.grayscale { 1 } else { 3 });
        let length = width / stack;
        for (place, env) in envs.iter().enumerate().filter(|_| !format.grayscale) {
            for (x, y, channel) in [(0, 0, 0), (5, 80, 1), (80, 5, 2), (41, 17, 0), (83, 83, 2)] {
                let at = x * number("x") + y * number("y") + channel * number("channel");
                let colour = colours[env * 84 * 84 * 3 + (x * 84 + y) * 3 + channel];
                assert_eq!(pixels[place * length + at], colour, "{format:?} environment {env}, {x} {y} {channel}");
            }
        }
    }
}

#[test]
fn without_frames_there_are_numbers() {
    let room = Room::new("numbers");
    let arguments = ["--env", "MortarMayhem-v0", "--num-envs", "3", "--groups", "2", "--no-frames", "--features"];
    let _engine = Engine::start(&room, &arguments);
    let server = Server::start(room.endless(&["view", "endless"]));
    let mut trainer = room.connect("endless");
    let mut socket = server.show("endless");
    socket.select(1, &[2, 1000]);
    wait_for_observers(&room, 2);
    trainer.reset(1, ResetRequest::Seed(3)).unwrap();
    let lease = trainer.receive(1, TIMEOUT).unwrap();
    let (about, pixels) = socket.wait(|about| about["batch"]["group"] == 1);
    assert!(pixels.is_empty());
    assert_eq!(about["batch"]["frame"], json!(null));
    let features = trainer.specification().features.clone();
    assert_eq!(about["batch"]["features"], json!(features));
    assert_eq!(about["batch"]["envs"].as_array().unwrap().len(), 1, "there are three environments");
    assert_eq!(about["batch"]["envs"][0]["features"], json!(lease.batch().features()[2 * features.len()..]));
}

#[test]
fn an_engine_is_lost_and_found_and_not_observed_without_a_browser() {
    let room = Room::new("view-lost");
    let server = Server::start(room.endless(&["view", "endless"]));
    let mut socket = server.show("endless");
    assert_eq!(socket.next().0["state"], "waiting");
    let arguments = ["--env", "MortarMayhem-Grid-v0", "--num-envs", "4", "--seed", "1"];
    let mut engine = Engine::start(&room, &arguments);
    let (about, _) = socket.wait(|about| about["state"] == "live");
    assert_eq!((&about["id"], &about["num_envs"]), (&json!("MortarMayhem-Grid-v0"), &json!(4)));
    engine.end();
    let (about, _) = socket.wait(|about| about["state"] == "lost");
    assert!(about["reason"].as_str().unwrap().contains("endless"), "{about}");
    let _engine = Engine::start(&room, &arguments);
    socket.wait(|about| about["state"] == "live");

    wait_for_observers(&room, 1);
    let mut trainer = room.connect("endless");
    trainer.reset(0, ResetRequest::Seed(1)).unwrap();
    trainer.receive(0, TIMEOUT).unwrap();
    socket.wait(|about| about["batch"]["step"] == 1);
    let (status, _, body) = server.get(&format!("/{}/engines", server.token()), &[]);
    let listed: serde_json::Value = serde_json::from_slice(&body).unwrap();
    assert_eq!((status, &listed["service"]), (200, &json!("endless")));
    let own = std::process::id();
    assert_eq!(listed["engines"][0]["trainers"], json!([own]));
    assert_eq!(listed["engines"][0]["observers"], json!([server.child.id()]));
    drop(socket);
    wait_for_observers(&room, 0);
    step(&mut trainer, 0);
    assert_eq!(observers(&room), 0);

    // Curves go on, with the points from before.
    let mut socket = server.show("endless");
    wait_for_observers(&room, 1);
    let first = socket.points();
    assert_eq!(first["anew"], true);
    for _ in 0..300 {
        step(&mut trainer, 0);
    }
    let episodes = EngineStatus::of(&Namespace::at(&room.root), "endless").unwrap().groups[0].episodes;
    assert!(episodes > 0);
    let point = loop {
        if let Some(point) = socket.points()["points"].as_array().and_then(|points| points.last().cloned())
            && point["episodes"] == episodes
        {
            break point;
        }
    };
    assert!(point["seconds"].as_f64().unwrap() > 0.0, "{point}");
}

/// Environment steps per second for a while.
fn steps_per_second(trainer: &mut Trainer, num_envs: usize) -> f64 {
    let (begin, mut steps) = (Instant::now(), 0);
    while begin.elapsed() < Duration::from_secs(2) {
        step(trainer, 0);
        steps += num_envs;
    }
    steps as f64 / begin.elapsed().as_secs_f64()
}

/// On an idle machine, and asserts nothing:
/// `cargo test --release --test view -- --ignored --exact measure_the_cost_of_a_page --nocapture`
#[test]
#[ignore = "a measurement"]
fn measure_the_cost_of_a_page() {
    const NUM_ENVS: usize = 256;
    const ROUNDS: usize = 7;
    let room = Room::new("measure");
    let num_envs = NUM_ENVS.to_string();
    let _engine = Engine::start(&room, &["--env", "MortarMayhem-v0", "--num-envs", &num_envs]);
    let server = Server::start(room.endless(&["view", "endless"]));
    let mut trainer = room.connect("endless");
    trainer.reset(0, ResetRequest::Seed(1)).unwrap();
    trainer.receive(0, TIMEOUT).unwrap();
    let (mut alone, mut shown) = (Vec::new(), Vec::new());
    for _ in 0..ROUNDS {
        wait_for_observers(&room, 0);
        alone.push(steps_per_second(&mut trainer, NUM_ENVS));
        let mut socket = server.show("endless");
        wait_for_observers(&room, 1);
        let done = std::sync::atomic::AtomicBool::new(false);
        std::thread::scope(|scope| {
            // The engine steps, so there always is a next message.
            scope.spawn(|| {
                while !done.load(std::sync::atomic::Ordering::Relaxed) {
                    socket.next();
                }
            });
            shown.push(steps_per_second(&mut trainer, NUM_ENVS));
            done.store(true, std::sync::atomic::Ordering::Relaxed);
        });
    }
    let median = |rates: &mut Vec<f64>| {
        rates.sort_by(f64::total_cmp);
        rates[ROUNDS / 2]
    };
    let (alone, shown) = (median(&mut alone), median(&mut shown));
    let load = std::fs::read_to_string("/proc/loadavg").unwrap();
    println!("{alone:.0} steps/s alone, {shown:.0} with a page: {:+.1} %, load {load}", (shown / alone - 1.0) * 100.0);
}
