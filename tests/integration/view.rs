//! `endless view`: what a browser receives from a running engine, and which requests are refused.

use std::fs;
use std::io::{BufRead, BufReader, Read};
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::Instant;

use crate::support::page::{BROWSER, Server, given};
use crate::support::place::Place;
use crate::support::player::Player;
use crate::support::process::{TIMEOUT, wait_until};
use crate::support::recorded::pixel_formats;
use crate::support::service::{reset, step};
use endless_gym::batch::Frames;
use endless_gym::pool::{PoolConfig, ResetRequest};
use endless_gym::popgym;
use endless_gym::service::{EngineStatus, Trainer};
use serde_json::json;

fn observers(place: &Place) -> usize {
    let status = EngineStatus::of(place.namespace(), "endless").unwrap();
    status.groups.iter().map(|group| group.observers.len()).sum()
}

fn wait_for_observers(place: &Place, expected: usize) {
    wait_until(&format!("{expected} observers"), || observers(place) == expected);
}

#[test]
fn the_token_the_host_and_the_origin_are_required() {
    let place = Place::new();
    let mut server = Server::start(place.endless(&["view"]));
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
    // The server has every file that the page uses.
    assert!(body.contains(&format!("<base href=\"/{token}/\">")), "{body}");
    for name in
        ["style.css", "view.css", "icon.svg", "dom.js", "view.js", "frames.js", "curves.js", "engines.js", "numbers.js"]
    {
        let (status, headers, body) = server.get(&format!("/{token}/{name}"), &[]);
        assert!(status == 200 && !body.is_empty(), "{name}: {headers}");
    }
    let wrong = format!("/?token={}", "0".repeat(32));
    for path in
        ["/", "/?token=", &wrong, "/style.css", "/view.js", "/engines", "/x/engines", "/x/socket?service=endless"]
    {
        assert_eq!(server.status(path, &[]), 403, "{path}");
    }
    let (own, localhost) = (server.address().to_string(), format!("localhost:{}", server.address().port()));
    let secure = format!("https://{own}");
    for foreign in [
        ("Host", "example.org"),
        ("Host", "localhost"),
        ("Host", "127.0.0.1:1"),
        ("Origin", "http://example.org"),
        ("Origin", "http://127.0.0.1:1"),
        ("Origin", &*secure),
        ("Origin", "null"),
    ] {
        for path in [page.clone(), format!("/{token}/engines"), format!("/{token}/socket?service=endless")] {
            assert_eq!(server.status(&path, &[foreign]), 403, "{foreign:?} {path}");
        }
    }
    for host in [own, localhost] {
        assert_eq!(server.status(&page, &[("Host", &host), ("Origin", &format!("http://{host}"))]), 200, "{host}");
    }
    for path in ["../Cargo.toml", "../../etc/passwd", "%2e%2e/Cargo.toml", "files/view.js", "view.rs", "index.html", ""]
    {
        assert_eq!(server.status(&format!("/{token}/{path}"), &[]), 404, "{path}");
    }
    // The server binds no other interface.
    assert!(server.address().ip().is_loopback());
    server.process.interrupt();
}

#[test]
fn frames_equal_the_bytes_of_the_batch_in_every_format() {
    for (number, format) in pixel_formats().enumerate() {
        let stack = [1, 3][number % 2];
        let place = Place::new();
        let id = "MysteryPath-Grid-v0";
        let stack_text = stack.to_string();
        let mut arguments = vec!["--env", id, "--num-envs", "5", "--seed", "7", "--frame-stack", &stack_text];
        arguments.extend(format.grayscale.then_some("--grayscale"));
        arguments.extend(format.channels_first.then_some("--channels-first"));
        arguments.extend(format.row_major.then_some("--row-major"));
        let _engine = place.serve(&arguments);
        let server = Server::start(place.endless(&["view", "endless"]));
        let mut trainer = place.trainer("endless").unwrap();
        let mut socket = server.show("endless");
        let envs = [3, 0, 4];
        socket.select(0, &envs);
        // A page shows only batches sent after its server has connected.
        socket.wait(|about| about["state"] == "live");
        let config = PoolConfig::new(id, 5).frames(Some(Frames { format, stack }));
        // The second twin plays the same episode with frames as [x][y][channel].
        let mut twins = [Player::new(&config), Player::new(&PoolConfig::new(id, 5))];
        reset(&mut trainer, 0);
        twins.iter_mut().for_each(|twin| twin.reset(ResetRequest::Seed(3)));
        for _ in 0..4 {
            step(&mut trainer, 0);
            twins.iter_mut().for_each(|twin| twin.step_all(1));
        }
        let (about, pixels) = socket.wait(|about| {
            about["batch"]["step"] == 5 && about["batch"]["envs"].as_array().is_some_and(|shown| shown.len() == 3)
        });
        let [batch, plain] = twins.each_ref().map(Player::batch);
        let width = batch.observation().len() / 5;
        let newest = |env: usize| &batch.observation()[(env + 1) * width - width / stack..(env + 1) * width];
        let expected: Vec<u8> = envs.iter().flat_map(|env| newest(*env)).copied().collect();
        assert!(pixels == expected, "{format:?} {stack}: other pixels");
        assert_eq!(about["batch"]["envs"][0]["env"], 3);
        assert_eq!(about["batch"]["envs"][2]["return"], batch.episode_return()[4]);
        assert_eq!(about["batch"]["envs"][1]["length"], batch.episode_length()[0]);

        // The strides give the pixels.
        let frame = &about["batch"]["frame"];
        let number = |name: &str| frame[name].as_u64().unwrap() as usize;
        assert_eq!((number("width"), number("height"), number("stack")), (84, 84, stack));
        assert_eq!(number("channels"), if format.grayscale { 1 } else { 3 });
        let length = width / stack;
        for (place, env) in envs.iter().enumerate().filter(|_| !format.grayscale) {
            for (x, y, channel) in [(0, 0, 0), (5, 80, 1), (80, 5, 2), (41, 17, 0), (83, 83, 2)] {
                let at = x * number("x") + y * number("y") + channel * number("channel");
                let colour = plain.observation()[env * 84 * 84 * 3 + (x * 84 + y) * 3 + channel];
                assert_eq!(pixels[place * length + at], colour, "{format:?} environment {env}, {x} {y} {channel}");
            }
        }
    }
}

#[test]
fn a_page_shows_pictures_and_numbers_of_environments_without_frames() {
    let place = Place::new();
    let arguments = ["--env", "popgym-RepeatFirstEasy-v0", "--num-envs", "3", "--groups", "2"];
    let _engine = place.serve(&arguments);
    let server = Server::start(place.endless(&["view", "endless"]));
    let mut trainer = place.trainer("endless").unwrap();
    let mut socket = server.show("endless");
    socket.select(1, &[2, 1000]);
    socket.wait(|about| about["state"] == "live");
    trainer.reset(1, ResetRequest::Seed(3)).unwrap();
    let lease = trainer.receive(1, TIMEOUT).unwrap();
    let (about, pixels) = socket.wait(|about| about["batch"]["group"] == 1 && about["batch"]["frame"].is_object());
    assert!(about["has_frames"] == true && pixels.len() == 84 * 84 * 3);
    // The picture of the same card in other environments.
    let mut twin = Player::in_registry(popgym(), &PoolConfig::new("popgym-RepeatFirstEasy-v0", 30), 1);
    twin.reset(ResetRequest::Seed(3));
    let card = lease.batch().features()[2];
    let env = twin.batch().features().iter().position(|other| *other == card).unwrap();
    assert!(pixels == twin.pool.frame(env).unwrap());
    let features = trainer.specification().features.clone();
    assert_eq!(about["batch"]["features"], json!(features));
    assert_eq!(about["batch"]["envs"].as_array().unwrap().len(), 1, "there are three environments");
    assert_eq!(about["batch"]["envs"][0]["features"], json!(lease.batch().features()[2 * features.len()..]));
}

#[test]
fn an_engine_without_frames_draws_what_a_page_shows() {
    let place = Place::new();
    let id = "MortarMayhem-v0";
    let _engine = place.serve(&["--env", id, "--num-envs", "6", "--no-frames", "--features"]);
    let server = Server::start(place.endless(&["view", "endless"]));
    let mut trainer = place.trainer("endless").unwrap();
    let mut twin = Player::new(&PoolConfig::new(id, 6));
    let mut sockets = [server.show("endless"), server.show("endless")];
    sockets[0].select(0, &[5, 2]);
    sockets[1].select(0, &[0]);
    let mut shown =
        sockets.each_mut().map(|socket| socket.wait(|about| about["state"] == "live").0["has_frames"].take());
    assert!(shown.iter_mut().all(|shown| shown == true));
    reset(&mut trainer, 0);
    twin.reset(ResetRequest::Seed(3));
    let frames = |twin: &Player, envs: &[usize]| -> Vec<u8> {
        envs.iter().flat_map(|env| twin.batch().observation().chunks(84 * 84 * 3).nth(*env).unwrap()).copied().collect()
    };
    for number in 2..7 {
        let features = step(&mut trainer, 0).batch().features().to_vec();
        twin.step_all(1);
        // The trainer pauses. The picture may follow after the numbers.
        for (socket, envs) in sockets.iter_mut().zip([&[5, 2][..], &[0]]) {
            let expected = frames(&twin, envs);
            let start = Instant::now();
            let about = loop {
                let (about, pixels) = socket.wait(|about| about["batch"]["step"] == number);
                if pixels == expected {
                    break about;
                }
                assert!(start.elapsed() < TIMEOUT, "{envs:?} at step {number}");
            };
            assert_eq!(about["batch"]["frame"]["width"], 84);
            let width = features.len() / 6;
            assert_eq!(about["batch"]["envs"][0]["features"], json!(features[envs[0] * width..][..width]));
        }
    }
    // Another environment, while the trainer pauses.
    sockets[1].select(0, &[3, 4]);
    let (_, pixels) =
        sockets[1].wait(|about| about["batch"]["frame"]["width"] == 84 && about["batch"]["envs"][1]["env"] == 4);
    assert!(pixels == frames(&twin, &[3, 4]));
}

#[test]
fn a_lost_engine_is_found_again_and_is_observed_only_for_a_browser() {
    let place = Place::new();
    let server = Server::start(place.endless(&["view", "endless"]));
    let mut socket = server.show("endless");
    assert_eq!(socket.next().0["state"], "waiting");
    let arguments = ["--env", "MortarMayhem-Grid-v0", "--num-envs", "4", "--seed", "1"];
    let mut engine = place.serve(&arguments);
    let (about, _) = socket.wait(|about| about["state"] == "live");
    assert_eq!((&about["id"], &about["num_envs"]), (&json!("MortarMayhem-Grid-v0"), &json!(4)));
    engine.interrupt();
    let (about, _) = socket.wait(|about| about["state"] == "lost");
    assert!(about["reason"].as_str().unwrap().contains("endless"), "{about}");
    let _engine = place.serve(&arguments);
    socket.wait(|about| about["state"] == "live");

    wait_for_observers(&place, 1);
    let mut trainer = place.trainer("endless").unwrap();
    reset(&mut trainer, 0);
    socket.wait(|about| about["batch"]["step"] == 1);
    let (status, _, body) = server.get(&format!("/{}/engines", server.token()), &[]);
    let listed: serde_json::Value = serde_json::from_slice(&body).unwrap();
    assert_eq!((status, &listed["service"]), (200, &json!("endless")));
    let own = std::process::id();
    assert_eq!(listed["engines"][0]["trainers"], json!([own]));
    assert_eq!(listed["engines"][0]["observers"], json!([server.process.id()]));
    drop(socket);
    wait_for_observers(&place, 0);
    // Loading the page and the list of engines observes no engine.
    for path in [
        format!("/?token={}", server.token()),
        format!("/{}/view.js", server.token()),
        format!("/{}/engines", server.token()),
    ] {
        assert_eq!(server.status(&path, &[]), 200);
    }
    step(&mut trainer, 0);
    assert_eq!(observers(&place), 0);

    // The curves continue after their earlier points.
    let mut socket = server.show("endless");
    wait_for_observers(&place, 1);
    let first = socket.points();
    assert_eq!(first["anew"], true);
    for _ in 0..300 {
        step(&mut trainer, 0);
    }
    let episodes = EngineStatus::of(place.namespace(), "endless").unwrap().groups[0].episodes;
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
    let place = Place::new();
    let (browser, desktop) = (place.script("browser", BROWSER), place.script("bin/xdg-open", BROWSER));
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
        let mut command = place.endless(&["view", "--open"]);
        command.env("PATH", &path).env_remove("BROWSER").envs(variable.as_ref().map(|value| ("BROWSER", value)));
        let mut server = Server::start(command);
        let given = given(program);
        let page = given.split("file://").nth(1).and_then(|rest| rest.split(' ').next()).unwrap_or(&given).to_owned();
        assert_eq!(given, arguments.replace("URL", &format!("file://{page}")), "{variable:?}");
        assert!(!given.contains(server.token()), "all users can read the arguments");
        assert!(fs::read_to_string(&page).unwrap().contains(&format!("url={}\"", server.url)));
        assert_eq!(fs::metadata(&page).unwrap().permissions().mode() & 0o777, 0o600);
        server.process.interrupt();
        assert_eq!(server.process.errors(), "", "{variable:?}");
        assert!(!Path::new(&page).exists());
    }
}

#[test]
fn the_page_is_served_without_a_browser_and_one_line_reports_it() {
    let place = Place::new();
    std::fs::create_dir(place.root().join("empty")).unwrap();
    place.script("failing/xdg-open", "echo > \"$0.ran\"; exit 3");
    let failed = place.root().join("failing/xdg-open.ran");
    for (folder, browser, message) in [
        ("empty", None, "endless: --open found no browser (`xdg-open`: No such file or directory"),
        ("empty", Some("/missing/one"), "endless: --open found no browser (`/missing/one`: No such file or directory"),
        ("failing", None, "endless: --open: `xdg-open` failed (exit status: 3); open the address yourself\n"),
    ] {
        let mut command = place.endless(&["view", "--open"]);
        command
            .env("PATH", place.root().join(folder))
            .env_remove("BROWSER")
            .envs(browser.map(|value| ("BROWSER", value)));
        let mut server = Server::start(command);
        let mut stderr = BufReader::new(server.process.0.stderr.take().unwrap());
        let mut line = String::new();
        stderr.read_line(&mut line).unwrap();
        assert!(line.starts_with(message) && line.ends_with("open the address yourself\n"), "{line}");
        assert_eq!(failed.exists(), folder == "failing");
        assert_eq!(server.status(&format!("/?token={}", server.token()), &[]), 200, "it goes on");
        server.process.interrupt();
        line.clear();
        stderr.read_to_string(&mut line).unwrap();
        assert_eq!(line, "", "one line is enough");
    }
}

/// Steps without pause while `work` runs.
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

/// Batches that the page's observer has taken.
fn taken(place: &Place) -> usize {
    let status = EngineStatus::of(place.namespace(), "endless").unwrap();
    status.groups[0].observers[0].batches as usize
}

#[test]
fn a_batch_is_taken_only_for_a_message() {
    let place = Place::new();
    let _engine = place.serve(&["--env", "MortarMayhem-Grid-v0", "--num-envs", "2"]);
    let server = Server::start(place.endless(&["view", "endless"]));
    let mut trainer = place.trainer("endless").unwrap();
    reset(&mut trainer, 0);
    let mut socket = server.show("endless");
    wait_for_observers(&place, 1);
    // A page that shows environments, and one in the background, which gets one message per status.
    for (shown, least) in [(&[0, 1][..], 20), (&[], 3)] {
        socket.select(0, shown);
        // Skip messages for the previous selection.
        let (begin, messages) = train_while(&mut trainer, || {
            socket.wait(|about| about["batch"]["envs"].as_array().is_some_and(|envs| envs.len() == shown.len()));
            let begin = taken(&place);
            for _ in 0..least {
                socket.next();
            }
            (begin, least)
        });
        // Count the messages still on their way, up to the answer to a new, distinct selection.
        socket.select(0, &[1]);
        let mut messages = messages + 1;
        while socket.next().0["batch"]["envs"].as_array().is_none_or(|envs| envs.len() != 1) {
            messages += 1;
        }
        let taken = taken(&place) - begin;
        assert!(taken <= messages && taken > 0, "{taken} batches for {messages} messages, {shown:?}");
    }
}

#[test]
fn a_busy_engine_writes_to_one_buffer_while_a_page_shows_it() {
    let place = Place::new();
    let _engine = place.serve(&["--env", "MortarMayhem-Grid-v0", "--num-envs", "100"]);
    let server = Server::start(place.endless(&["view", "endless"]));
    let mut trainer = place.trainer("endless").unwrap();
    reset(&mut trainer, 0);
    let mut socket = server.show("endless");
    wait_for_observers(&place, 1);
    for shown in [&[0, 99][..], &[]] {
        socket.select(0, shown);
        let messages = AtomicUsize::new(0);
        let last = std::thread::scope(|scope| {
            let training = scope.spawn(|| {
                // Successive batches in the same memory. With an active observer, there are never two.
                let (mut address, mut in_a_row, start) = (0, 0, Instant::now());
                loop {
                    assert!(start.elapsed() < TIMEOUT, "{in_a_row} batches in one buffer, {shown:?}");
                    let lease = step(&mut trainer, 0);
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
        // The page shows the last batch, even of environments not shown before.
        socket.wait(|about| about["batch"]["step"] == last);
        socket.select(0, &[7, 50, 98]);
        socket.wait(|about| {
            about["batch"]["step"] == last && about["batch"]["envs"].as_array().is_some_and(|envs| envs.len() == 3)
        });
    }
}
