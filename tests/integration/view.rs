//! `endless view`: what a browser receives of a running engine, and who is refused.

use std::io::{BufRead, BufReader, Read};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use crate::support::page::{BROWSER, Server, given};
use crate::support::program::{Engine, Room, signal, wait};
use endless_gym::batch::{Batch, Frames, PixelFormat, zeroed};
use endless_gym::pool::{Pool, PoolConfig, ResetRequest, Threads};
use endless_gym::service::{EngineStatus, Namespace, Trainer};
use rustix::process::Signal;
use serde_json::json;

const TIMEOUT: Duration = Duration::from_secs(30);

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

#[test]
fn the_page_is_opened_in_a_browser() {
    let room = Room::new("view-open");
    let (browser, desktop) = (room.program("browser", BROWSER), room.program("bin/xdg-open", BROWSER));
    let path = format!("{}:/usr/bin:/bin", desktop.parent().unwrap().display());
    let named = browser.display();
    for (variable, program, arguments) in [
        (Some(format!("{named}")), &browser, "URL"),
        (Some(format!("{named} --new-window --url=%s -x")), &browser, "--new-window --url=URL -x"),
        (Some(format!("/missing/one:{named}:/missing/two")), &browser, "URL"),
        (Some("/missing/one".to_owned()), &desktop, "URL"),
        (Some(String::new()), &desktop, "URL"),
        (None, &desktop, "URL"),
    ] {
        let mut command = room.endless(&["view", "--open"]);
        command.env("PATH", &path).env_remove("BROWSER").envs(variable.as_ref().map(|value| ("BROWSER", value)));
        let mut server = Server::start(command);
        assert_eq!(given(program), arguments.replace("URL", &server.url), "{variable:?}");
        signal(&server.child, Signal::INT);
        assert!(wait(&mut server.child).success());
        assert_eq!(errors(&mut server), "", "{variable:?}");
    }
}

/// What a server that has ended wrote to standard error.
fn errors(server: &mut Server) -> String {
    let mut text = String::new();
    server.child.stderr.take().unwrap().read_to_string(&mut text).unwrap();
    text
}

#[test]
fn without_a_browser_the_page_is_served_and_one_line_says_why() {
    let room = Room::new("view-no-browser");
    std::fs::create_dir(room.root.join("empty")).unwrap();
    room.program("failing/xdg-open", "echo > \"$0.ran\"; exit 3");
    let failed = room.root.join("failing/xdg-open.ran");
    for (folder, browser, message) in [
        ("empty", None, "endless: --open found no browser (`xdg-open`: No such file or directory"),
        ("empty", Some("/missing/one"), "endless: --open found no browser (`/missing/one`: No such file or directory"),
        ("failing", None, "endless: --open: `xdg-open` failed (exit status: 3); open the address yourself\n"),
    ] {
        let mut command = room.endless(&["view", "--open"]);
        command.env("PATH", room.root.join(folder)).env_remove("BROWSER").envs(browser.map(|value| ("BROWSER", value)));
        let mut server = Server::start(command);
        let mut stderr = BufReader::new(server.child.stderr.take().unwrap());
        let mut line = String::new();
        stderr.read_line(&mut line).unwrap();
        assert!(line.starts_with(message) && line.ends_with("open the address yourself\n"), "{line}");
        assert_eq!(failed.exists(), folder == "failing");
        assert_eq!(server.status(&format!("/?token={}", server.token()), &[]), 200, "it goes on");
        signal(&server.child, Signal::INT);
        assert!(wait(&mut server.child).success());
        line.clear();
        stderr.read_to_string(&mut line).unwrap();
        assert_eq!(line, "", "one line is enough");
    }
}

/// Steps without a pause until it is told to stop.
fn train_while<R>(trainer: &mut Trainer, work: impl FnOnce() -> R) -> R {
    let done = AtomicBool::new(false);
    std::thread::scope(|scope| {
        let training = scope.spawn(|| {
            while !done.load(Ordering::Relaxed) {
                step(trainer, 0);
            }
        });
        let result = work();
        done.store(true, Ordering::Relaxed);
        training.join().unwrap();
        result
    })
}

#[test]
fn without_a_page_no_batch_is_taken() {
    let room = Room::new("view-idle");
    let _engine = Engine::start(&room, &["--env", "MortarMayhem-Grid-v0", "--num-envs", "4"]);
    let server = Server::start(room.endless(&["view", "endless"]));
    let mut trainer = room.connect("endless");
    trainer.reset(0, ResetRequest::Seed(1)).unwrap();
    trainer.receive(0, TIMEOUT).unwrap();
    // Reading the page and the list of engines is not looking at one.
    let token = server.token().to_owned();
    for path in [format!("/?token={token}"), format!("/{token}/view.js"), format!("/{token}/engines")] {
        assert_eq!(server.status(&path, &[]), 200);
        step(&mut trainer, 0);
        assert_eq!(observers(&room), 0, "{path}");
    }
    let (_, _, body) = server.get(&format!("/{token}/engines"), &[]);
    let listed: serde_json::Value = serde_json::from_slice(&body).unwrap();
    assert_eq!(
        (&listed["engines"][0]["observers"], &listed["engines"][0]["held_by_observers"]),
        (&json!([]), &json!(0))
    );
    let socket = server.show("endless");
    wait_for_observers(&room, 1);
    drop(socket);
    wait_for_observers(&room, 0);
    for _ in 0..100 {
        step(&mut trainer, 0);
    }
    assert_eq!(observers(&room), 0);
}

/// Batches that the page's observer has taken.
fn taken(room: &Room) -> usize {
    let status = EngineStatus::of(&Namespace::at(&room.root), "endless").unwrap();
    status.groups[0].observers[0].batches as usize
}

#[test]
fn a_batch_is_taken_only_for_a_message() {
    let room = Room::new("view-taken");
    let _engine = Engine::start(&room, &["--env", "MortarMayhem-Grid-v0", "--num-envs", "2"]);
    let server = Server::start(room.endless(&["view", "endless"]));
    let mut trainer = room.connect("endless");
    trainer.reset(0, ResetRequest::Seed(1)).unwrap();
    trainer.receive(0, TIMEOUT).unwrap();
    let mut socket = server.show("endless");
    wait_for_observers(&room, 1);
    // One that shows environments, and one in the background, which gets one message with each status.
    for (shown, least) in [(&[0, 1][..], 20), (&[], 3)] {
        socket.select(0, shown);
        // Until the selection is in effect, messages are those of the one before.
        let (begin, messages) = train_while(&mut trainer, || {
            socket.wait(|about| about["batch"]["envs"].as_array().is_some_and(|envs| envs.len() == shown.len()));
            let begin = taken(&room);
            for _ in 0..least {
                socket.next();
            }
            (begin, least)
        });
        // What is on its way, up to the answer to a selection that no other message has.
        socket.select(0, &[1]);
        let mut messages = messages + 1;
        while socket.next().0["batch"]["envs"].as_array().is_none_or(|envs| envs.len() != 1) {
            messages += 1;
        }
        let taken = taken(&room) - begin;
        assert!(taken <= messages && taken > 0, "{taken} batches for {messages} messages, {shown:?}");
    }
}

#[test]
fn a_busy_engine_writes_to_one_buffer_while_a_page_shows_it() {
    let room = Room::new("view-one");
    let _engine = Engine::start(&room, &["--env", "MortarMayhem-Grid-v0", "--num-envs", "100"]);
    let server = Server::start(room.endless(&["view", "endless"]));
    let mut trainer = room.connect("endless");
    trainer.reset(0, ResetRequest::Seed(1)).unwrap();
    trainer.receive(0, TIMEOUT).unwrap();
    let mut socket = server.show("endless");
    wait_for_observers(&room, 1);
    for shown in [&[0, 99][..], &[]] {
        socket.select(0, shown);
        let messages = AtomicUsize::new(0);
        let last = std::thread::scope(|scope| {
            let training = scope.spawn(|| {
                // Batches in a row that have come in the same memory. With an observer that can receive there are no two.
                let (mut address, mut in_a_row, start) = (0, 0, Instant::now());
                loop {
                    assert!(start.elapsed() < TIMEOUT, "{in_a_row} batches in one buffer, {shown:?}");
                    trainer.send_with(0, |actions| actions.fill(1)).unwrap();
                    let lease = trainer.receive(0, TIMEOUT).unwrap();
                    let before = std::mem::replace(&mut address, lease.blocks().as_ptr().addr());
                    in_a_row = if before == address { in_a_row + 1 } else { 0 };
                    if in_a_row >= 50 && messages.load(Ordering::Relaxed) >= 3 {
                        return lease.step();
                    }
                }
            });
            while !training.is_finished() {
                socket.next();
                messages.fetch_add(1, Ordering::Relaxed);
            }
            training.join().unwrap()
        });
        // The last batch is shown, also of other environments than before.
        socket.wait(|about| about["batch"]["step"] == last);
        socket.select(0, &[7, 50, 98]);
        socket.wait(|about| {
            about["batch"]["step"] == last && about["batch"]["envs"].as_array().is_some_and(|envs| envs.len() == 3)
        });
    }
}

/// Environment steps per second over a while, and the batches per second that come in other memory than the one before.
fn steps_per_second(trainer: &mut Trainer, num_envs: usize) -> (f64, f64) {
    let (begin, mut steps, mut address, mut moved) = (Instant::now(), 0, 0, 0);
    while begin.elapsed() < Duration::from_secs(1) {
        trainer.send_with(0, |actions| actions.fill(1)).unwrap();
        let lease = trainer.receive(0, TIMEOUT).unwrap();
        let before = std::mem::replace(&mut address, lease.blocks().as_ptr().addr());
        moved += usize::from(before != address);
        steps += num_envs;
    }
    let seconds = begin.elapsed().as_secs_f64();
    (steps as f64 / seconds, moved as f64 / seconds)
}

/// Processor time that a process has used, in the kernel's ticks of 10 milliseconds.
fn processor_ticks(pid: u32) -> f64 {
    let stat = std::fs::read_to_string(format!("/proc/{pid}/stat")).unwrap();
    // The name may have spaces.
    let fields: Vec<&str> = stat.rsplit(')').next().unwrap().split_whitespace().collect();
    fields[11..13].iter().map(|ticks| ticks.parse::<f64>().unwrap()).sum()
}

/// The middle of an odd number of values.
fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

/// What a page costs the engine, on an idle machine; asserts nothing:
/// `cargo test --release --test integration -- --ignored --nocapture measure_the_cost_of_a_page`
///
/// Alone, with a page of 16 environments, and with one in the background take turns, and each is compared with the mean of the times
/// alone before and after it. Two counts depend less on the load of the machine: batches that the engine wrote to other memory than the
/// one before, and the processor time of the page's server. The reader is this process and draws nothing: a browser's own work is not part of it.
#[test]
#[ignore = "a measurement"]
fn measure_the_cost_of_a_page() {
    const ROUNDS: usize = 15;
    let load = || std::fs::read_to_string("/proc/loadavg").unwrap().trim().to_owned();
    println!("{ROUNDS} rounds, medians; load before: {}", load());
    for num_envs in [16, 256, 1024] {
        let room = Room::new("measure");
        let _engine = Engine::start(&room, &["--env", "MortarMayhem-v0", "--num-envs", &num_envs.to_string()]);
        let server = Server::start(room.endless(&["view", "endless"]));
        let mut trainer = room.connect("endless");
        trainer.reset(0, ResetRequest::Seed(1)).unwrap();
        trainer.receive(0, TIMEOUT).unwrap();
        steps_per_second(&mut trainer, num_envs);
        let mut alone = vec![steps_per_second(&mut trainer, num_envs).0];
        let sixteen: Vec<usize> = (0..16).collect();
        let pages = [("16 environments", &sixteen[..]), ("in the background", &[])];
        let (mut shown, mut moved, mut ticks) = ([Vec::new(), Vec::new()], [0.0; 2], [0.0; 2]);
        for round in 0..2 * ROUNDS {
            let mut socket = server.show("endless");
            socket.select(0, pages[round % 2].1);
            wait_for_observers(&room, 1);
            let done = AtomicBool::new(false);
            std::thread::scope(|scope| {
                // The engine steps, so there always is a next message.
                scope.spawn(|| {
                    while !done.load(Ordering::Relaxed) {
                        socket.next();
                    }
                });
                let before = processor_ticks(server.child.id());
                let (rate, moves) = steps_per_second(&mut trainer, num_envs);
                shown[round % 2].push(rate);
                moved[round % 2] += moves / ROUNDS as f64;
                ticks[round % 2] += (processor_ticks(server.child.id()) - before) / ROUNDS as f64;
                done.store(true, Ordering::Relaxed);
            });
            drop(socket);
            wait_for_observers(&room, 0);
            alone.push(steps_per_second(&mut trainer, num_envs).0);
        }
        println!("{num_envs:5} environments: {:.0} steps/s alone", median(alone.iter().copied()));
        for (which, ((page, _), rates)) in pages.iter().zip(&shown).enumerate() {
            let ratios = rates.iter().enumerate().map(|(round, rate)| {
                let place = 2 * round + which;
                2.0 * rate / (alone[place] + alone[place + 1])
            });
            let mut ratios: Vec<f64> = ratios.collect();
            ratios.sort_by(f64::total_cmp);
            println!(
                "    page with {page:17}: {:.0} steps/s, ratio {:.4} (quartiles {:.4} to {:.4}); each second {:.0} \
                 batches in other memory, {:.0} ms of the page's server",
                median(rates.iter().copied()),
                ratios[ROUNDS / 2],
                ratios[ROUNDS / 4],
                ratios[ROUNDS - 1 - ROUNDS / 4],
                moved[which],
                10.0 * ticks[which]
            );
        }
    }
    println!("load after: {}", load());
}
