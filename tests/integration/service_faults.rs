//! Faults outside the service: full and small shared memory, removed directories, stopped processes, other users, few
//! descriptors.
//!
//! Tests that need a mount namespace or root are ignored; `cargo xtask test --all` runs them where the system permits
//! it. They start this test program again inside such a namespace.

use std::fs::{self, File, Permissions};
use std::io::Write;
use std::os::unix::fs::PermissionsExt;
use std::os::unix::process::ExitStatusExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use crate::support::foreign;
use crate::support::place::Place;
use crate::support::process::{Process, TIMEOUT, inside_namespace, unshare, wait_until};
use crate::support::service::{ID, assert_error, play, reset, step};
use endless_gym::memory_gym;
use endless_gym::pool::ResetRequest;
use endless_gym::service::{Engine, LockHolder, Observer, ServiceError, running_engines};
use rustix::process::Signal;

const SEGMENTS: &str = "/dev/shm";

/// The command `endless serve`.
fn serve(place: &Place, service: &str) -> Command {
    let mut command = place.endless(&["serve", "--env", ID, "--num-envs", "2", "--service", service]);
    command.stdout(Stdio::null());
    command
}

#[test]
#[ignore = "needs permission to create mount namespaces (unshare --mount --map-root-user)"]
fn inside_full_shared_memory_an_engine_reports_it_and_leaves_nothing() {
    let name = "service_faults::inside_full_shared_memory_an_engine_reports_it_and_leaves_nothing";
    if !inside_namespace(name, "mount -t tmpfs -o size=8M tmpfs /dev/shm") {
        return;
    }
    let place = Place::new();
    let filler = Path::new(SEGMENTS).join("filler");
    fs::write(&filler, vec![1; 9 << 20]).unwrap_err();
    let output = serve(&place, "gym").output().unwrap();
    let text = String::from_utf8_lossy(&output.stderr);
    assert_eq!((output.status.code(), output.status.signal()), (Some(1), None), "{text}");
    assert!(text.contains("/dev/shm has 0 MB free; use fewer environments"), "{text}");
    assert_eq!(place.segments(), [] as [PathBuf; 0]);
    // An engine starts as soon as there is room.
    fs::remove_file(filler).unwrap();
    let _engine = place.engine("gym", 2, 1);
    play(&mut place.trainer("gym").unwrap(), 0, 3);
}

#[test]
#[ignore = "needs permission to create mount namespaces (unshare --mount --map-root-user)"]
fn inside_memory_that_dead_processes_fill_an_engine_starts() {
    let name = "service_faults::inside_memory_that_dead_processes_fill_an_engine_starts";
    if !inside_namespace(name, "mount -t tmpfs -o size=8M tmpfs /dev/shm") {
        return;
    }
    let place = Place::new();
    let mut engine = place.engine("gym", 2, 1);
    play(&mut place.trainer("gym").unwrap(), 0, 1);
    engine.kill();
    // A segment of the dead engine takes the rest of the memory.
    let segment = place.segments().into_iter().find(|path| path.extension().unwrap() == "data").unwrap();
    let mut file = File::options().append(true).open(segment).unwrap();
    file.write_all(&vec![1; 9 << 20]).unwrap_err();
    drop(file);
    let _engine = place.engine("gym", 2, 1);
    play(&mut place.trainer("gym").unwrap(), 0, 3);
}

#[test]
fn an_unusable_counter_of_a_dead_process_is_replaced() {
    let place = Place::new();
    // A plain iceoryx2 process leaves its counter behind; one that dies while it creates the counter leaves it in this
    // state.
    let _foreign = foreign::engine_of_version(place.namespace(), "old", 999);
    let counters = || place.segments().into_iter().filter(|path| path.extension().unwrap() == "global_mgmt");
    let left: Vec<_> = counters().collect();
    assert_eq!(left.len(), 1);
    fs::set_permissions(&left[0], Permissions::from_mode(0o200)).unwrap();
    assert_eq!(running_engines(place.namespace()).unwrap(), ["old"]);
    let _engine = place.engine("gym", 2, 1);
    play(&mut place.trainer("gym").unwrap(), 0, 1);
    assert_eq!(counters().count(), 0);
}

#[test]
#[ignore = "needs to run as root, to create a segment of another user"]
fn as_root_a_segment_of_another_user_is_reported_or_avoided() {
    let place = Place::new();
    let engine = place.engine("gym", 2, 1);
    drop(place.trainer("gym").unwrap());
    let prefix = fs::read_to_string(place.root().join("prefix")).unwrap();
    let planted = Path::new(SEGMENTS).join(format!("{prefix}planted"));
    File::create(&planted).unwrap();
    std::os::unix::fs::chown(&planted, Some(65534), Some(65534)).unwrap();
    let error = assert_error!(place.trainer("gym"), ServiceError::ForeignSegment { owner: 65534, .. });
    assert!(error.to_string().contains("65534") && error.to_string().contains("ENDLESS_GYM_ROOT"), "{error}");
    // Without engines and trainers, the namespace gets another prefix.
    engine.end();
    let _engine = place.engine("gym", 2, 1);
    play(&mut place.trainer("gym").unwrap(), 0, 1);
    assert_ne!(fs::read_to_string(place.root().join("prefix")).unwrap(), prefix);
}

#[test]
#[ignore = "needs permission to create mount namespaces (unshare --mount --map-root-user)"]
fn two_directories_of_one_path_share_nothing() {
    let (place, _engine, mut trainer) = Place::started(2, 1);
    play(&mut trainer, 0, 1);
    let before = place.segments();
    let root = place.root().display().to_string();
    let output = unshare(&format!("mount -t tmpfs -o mode=700 tmpfs {root}"))
        .arg(env!("CARGO_BIN_EXE_endless"))
        .args(["serve", "--num-envs", "2", "--threads", "1", "--service", "gym", "--child"])
        .env("ENDLESS_GYM_ROOT", &root)
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    assert_eq!(place.segments(), before);
    play(&mut trainer, 0, 1);
    drop(trainer);
    play(&mut place.trainer("gym").unwrap(), 0, 1);
}

#[test]
fn serve_restarts_an_engine_whose_directory_is_removed() {
    let place = Place::new();
    let mut engine = Process::spawn(serve(&place, "gym").stderr(Stdio::null()));
    let mut trainer = place.trainer("gym").unwrap();
    let mut observer = Observer::connect(&place.connect_config("gym"), 0).unwrap();
    play(&mut trainer, 0, 1);
    fs::remove_dir_all(place.root()).unwrap();
    // Another process creates the directory again.
    running_engines(place.namespace()).unwrap();
    let start = Instant::now();
    let error = loop {
        let sent = trainer.reset(0, ResetRequest::Seed(3));
        match sent.and_then(|()| trainer.receive(0, TIMEOUT).map(drop)) {
            Ok(()) => assert!(start.elapsed() < TIMEOUT, "the engine does not notice"),
            Err(error) => break error,
        }
    };
    assert!(matches!(error, ServiceError::RootRemoved { .. }), "{error}");
    assert_error!(observer.next(TIMEOUT).and_then(|_| observer.next(TIMEOUT)), ServiceError::RootRemoved { .. });
    trainer.reconnect(TIMEOUT).unwrap();
    play(&mut trainer, 0, 3);
    assert_eq!(trainer.specification().engine_pid, engine.id());
    assert!(start.elapsed() < Duration::from_secs(4), "{:?}", start.elapsed());
    drop((trainer, observer));
    engine.signal(Signal::TERM);
    assert!(engine.wait().success());
    place.assert_nothing_left();
}

#[test]
fn an_engine_ends_with_an_error_when_its_directory_is_removed() {
    let place = Place::new();
    let engine = Engine::new(memory_gym(), &place.engine_config("gym", 1, 1)).unwrap();
    fs::remove_dir_all(place.root()).unwrap();
    let start = Instant::now();
    assert_error!(engine.spawn().unwrap().join(), ServiceError::RootRemoved { .. });
    assert!(start.elapsed() < Duration::from_secs(2));
}

/// Stops engines for a second at various moments of their start, while other processes list engines.
#[test]
fn an_engine_that_is_stopped_while_it_starts_can_be_found() {
    let place = Place::new();
    let stop = AtomicBool::new(false);
    std::thread::scope(|scope| {
        for _ in 0..2 {
            scope.spawn(|| {
                while !stop.load(Ordering::Relaxed) {
                    match running_engines(place.namespace()) {
                        Ok(_) | Err(ServiceError::NamespaceLocked { .. }) => {}
                        Err(e) => panic!("{e}"),
                    }
                    std::thread::sleep(Duration::from_millis(10));
                }
            });
        }
        let names: Vec<String> = (0..12).map(|number| format!("gym{number}")).collect();
        let engines: Vec<_> = names
            .iter()
            .zip(0..)
            .map(|(name, number)| {
                let engine = place.engine(name, 1, 1);
                std::thread::sleep(Duration::from_millis(3 * number));
                engine.signal(Signal::STOP);
                engine
            })
            .collect();
        std::thread::sleep(Duration::from_millis(1200));
        engines.iter().for_each(Process::resume);
        for name in &names {
            play(&mut place.trainer(name).unwrap_or_else(|e| panic!("{name}: {e}")), 0, 1);
        }
        stop.store(true, Ordering::Relaxed);
    });
}

#[test]
fn waiters_name_a_stopped_holder_of_the_lock_and_continue_after_it() {
    let place = Place::new();
    let _engine = place.engine("gym", 1, 1);
    drop(place.trainer("gym").unwrap());
    let root = place.root().to_owned();
    let mut flock = Command::new("flock");
    let mut holder = Process::spawn(flock.arg("--no-fork").arg(&root).args(["sleep", "60"]).stdin(Stdio::null()));
    wait_until("flock holds the lock", || File::open(&root).unwrap().try_lock().is_err());
    holder.stop();
    std::thread::scope(|scope| {
        let waiting = scope.spawn(|| place.trainer("gym").map(drop));
        let (found, expected) = (running_engines(place.namespace()), LockHolder { pid: holder.id(), stopped: true });
        let error = assert_error!(found, ServiceError::NamespaceLocked { holder: Some(it), .. } if *it == expected);
        assert!(error.to_string().contains("kill -CONT"), "{error}");
        // A caller with a longer timeout continues as soon as the lock is free.
        holder.kill();
        waiting.join().unwrap().unwrap();
    });
}

#[test]
#[ignore = "needs permission to create mount namespaces (unshare --mount --map-root-user)"]
fn inside_small_shared_memory_observers_get_what_is_left() {
    let name = "service_faults::inside_small_shared_memory_observers_get_what_is_left";
    if !inside_namespace(name, "mount -t tmpfs -o size=14M tmpfs /dev/shm") {
        return;
    }
    let place = Place::new();
    // A batch has 1.36 MB; the engine and its trainer need five, each observer four.
    let mut engine = place.engine("gym", 64, 1);
    let mut trainer = place.trainer("gym").unwrap();
    let config = place.connect_config("gym");
    let mut observer = Observer::connect(&config, 0).unwrap();
    assert_error!(Observer::connect(&config, 0), ServiceError::SharedMemoryTooSmall { .. });
    // Another file takes the rest.
    fs::write(Path::new(SEGMENTS).join("filler"), vec![1; 14 << 20]).unwrap_err();
    let (mut seen, mut held) = (Vec::new(), Vec::new());
    held.push(reset(&mut trainer, 0));
    for _ in 0..10 {
        if seen.len() < 3 {
            seen.push(observer.next(TIMEOUT).unwrap());
        }
        if held.len() == 3 {
            held.remove(0);
        }
        held.push(step(&mut trainer, 0));
    }
    assert_eq!(seen.len(), 3);
    engine.kill();
}

/// What SIGBUS leaves: segments that are shorter than their content, at which iceoryx2 panics.
#[test]
fn damaged_segments_of_a_dead_engine_end_neither_a_running_nor_a_new_one() {
    let place = Place::new();
    let mut running = place.engine("running", 1, 1);
    drop(place.trainer("running").unwrap());
    let of_running = place.segments();
    let mut damaged = place.engine("damaged", 1, 1);
    drop(place.trainer("damaged").unwrap());
    running.stop();
    damaged.kill();
    let segments = place.segments().into_iter().filter(|path| !of_running.contains(path));
    for segment in
        segments.filter(|path| fs::metadata(path).unwrap().len() > 100 && path.extension().unwrap() != "status")
    {
        File::options().write(true).open(segment).unwrap().set_len(100).unwrap();
    }
    running.resume();
    // Longer than until an idle engine looks for dead processes.
    std::thread::sleep(Duration::from_secs(1));
    assert_eq!(running.0.try_wait().unwrap(), None);
    let next = place.engine("next", 1, 1);
    for engine in ["running", "next"] {
        play(&mut place.trainer(engine).unwrap(), 0, 2);
    }
    next.end();
    running.end();
    let alone = place.engine("alone", 1, 1);
    play(&mut place.trainer("alone").unwrap(), 0, 2);
    alone.end();
    place.assert_nothing_left();
}

#[test]
fn few_descriptors_are_an_error_or_enough() {
    let place = Place::new();
    // Close the descriptors that this process has opened for other tests.
    let closed = "for fd in /proc/$$/fd/*; do fd=${fd##*/}; if ((fd > 2)); then eval \"exec $fd>&-\"; fi; done";
    let limited = |limit: u64| {
        let mut command = place.command("bash");
        command.args(["-c", &format!("{closed}; ulimit -n {limit} && exec \"$0\" \"$@\"")]);
        command.arg(env!("CARGO_BIN_EXE_endless")).args(["serve", "--env", ID, "--num-envs=2", "--groups=2"]);
        Process::spawn(command.arg("--service=gym").stdout(Stdio::null()).stderr(Stdio::piped()))
    };
    let needed = [20, 40, 60].map(|limit| {
        let mut engine = limited(limit);
        let text = engine.errors();
        assert_eq!(engine.wait().code(), Some(1), "{text}");
        assert!(text.contains(&format!("the limit of this process is {limit}")), "{text}");
        text.split_whitespace().nth(1).unwrap().parse().unwrap()
    });
    assert_eq!(needed, [needed[0]; 3], "the whole need is said at once");
    // The number in the message suffices for a trainer and all observers.
    let _engine = limited(needed[0]);
    let mut trainer = place.trainer("gym").unwrap();
    let config = place.connect_config("gym");
    let mut observers: Vec<_> = (0..6).map(|number| Observer::connect(&config, number % 2).unwrap()).collect();
    for group in 0..2 {
        play(&mut trainer, group, 2);
    }
    observers.iter_mut().for_each(|observer| drop(observer.next(TIMEOUT).unwrap()));
}

#[test]
fn limits_of_memory_and_files_are_named_and_nothing_is_left() {
    let place = Place::new();
    for (option, limits) in [("-v", &[45_000, 80_000, 110_000][..]), ("-f", &[0, 16, 64, 1000])] {
        for limit in limits {
            let mut command = place.command("bash");
            command.args(["-c", &format!("ulimit {option} {limit} && exec \"$0\" \"$@\"")]);
            command.arg(env!("CARGO_BIN_EXE_endless")).args(["serve", "--env", ID, "--num-envs=512", "--threads=1"]);
            let mut engine = Process::spawn(command.stdout(Stdio::null()).stderr(Stdio::piped()));
            let text = engine.errors();
            assert_eq!(engine.wait().code(), Some(1), "{option} {limit}: {text}");
            let is_named = text.contains(&format!("`ulimit {option}`")) || text.contains("File too large");
            assert!(is_named && text.lines().count() == 1, "{option} {limit}: {text}");
            place.assert_nothing_left();
        }
    }
}

#[test]
fn an_engine_reports_wrong_numbers_of_threads_and_a_full_output() {
    let place = Place::new();
    let many = serve(&place, "gym").args(["--threads", "9999999"]).output().unwrap();
    let text = String::from_utf8_lossy(&many.stderr);
    assert!(many.status.code() == Some(1) && text.contains("0 (one for each core) to 1024, got 9999999"), "{text}");
    let full = File::options().write(true).open("/dev/full").unwrap();
    let status = serve(&place, "gym").stdout(full).stderr(Stdio::null()).status().unwrap();
    assert_eq!(status.code(), Some(1));
    place.assert_nothing_left();
}
