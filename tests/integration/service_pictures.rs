//! What an engine without frames draws for viewers, which are trusted with nothing.

use std::collections::HashMap;
use std::fs::{self, File};
use std::io::Write;
use std::os::unix::fs::FileExt;
use std::path::PathBuf;

use crate::support::page::Server;
use crate::support::place::Place;
use crate::support::player::Player;
use crate::support::process::{Process, wait_until};
use crate::support::service::{reset, step};
use endless_gym::pool::{PoolConfig, ResetRequest};
use endless_gym::service::{Observer, Pictures};
use rustix::fs::{CWD, FileType, Mode, mknodat};

const ID: &str = "Endless-SearingSpotlights-v0";
const NUM_ENVS: usize = 5;
const FRAME: usize = 84 * 84 * 3;

fn serve(place: &Place) -> Process {
    place.serve(&["--env", ID, "--num-envs", "5", "--groups", "2", "--features", "--no-frames"])
}

/// A pool in this process with frames, which plays as a group of the engine.
fn twin(group: usize) -> Player {
    let (first_env, total_envs) = (group * NUM_ENVS, 2 * NUM_ENVS);
    let mut twin = Player::new(&PoolConfig::new(ID, NUM_ENVS).first_env(first_env).total_envs(total_envs));
    twin.reset(ResetRequest::Seed(3));
    twin
}

fn frames(twin: &Player, envs: &[usize]) -> Vec<u8> {
    envs.iter().flat_map(|env| &twin.batch().observation()[env * FRAME..][..FRAME]).copied().collect()
}

fn pictures(place: &Place) -> Pictures {
    let observer = Observer::connect(&place.connect_config("endless"), 0).unwrap();
    Pictures::of(&observer).unwrap().unwrap()
}

/// The viewers' files.
fn files(place: &Place) -> Vec<PathBuf> {
    let is_picture = |path: &PathBuf| path.extension().is_some_and(|suffix| suffix == "picture");
    place.segments().into_iter().filter(is_picture).collect()
}

/// Waits for the pictures of these environments at that step, and compares them with the observations of the same step.
fn assert_drawn(pictures: &mut Pictures, twin: &Player, group: usize, envs: &[usize], step: u64) {
    pictures.want(group, envs).unwrap();
    wait_until("the engine draws", || {
        pictures.refresh();
        pictures.newest().is_some_and(|drawn| (drawn.group, drawn.step, &*drawn.envs) == (group, step, envs))
    });
    assert!(pictures.newest().unwrap().frames == frames(twin, envs), "group {group} step {step} {envs:?}");
}

#[test]
fn every_picture_is_the_observation_of_its_step() {
    let place = Place::new();
    let _engine = serve(&place);
    let mut pictures = pictures(&place);
    let mut trainer = place.trainer("endless").unwrap();
    let (mut twin, envs) = (twin(1), [4, 0, 3]);
    pictures.want(1, &envs).unwrap();
    reset(&mut trainer, 1);
    let (mut expected, mut last, mut seen) = (HashMap::from([(1, frames(&twin, &envs))]), 1, 0);
    // Episodes end meanwhile, and the trainer never pauses.
    while seen < 8 {
        last = step(&mut trainer, 1).step();
        twin.step_all(1);
        expected.insert(last, frames(&twin, &envs));
        expected.remove(&last.saturating_sub(9));
        if pictures.refresh() {
            let drawn = pictures.newest().unwrap();
            assert_eq!((drawn.group, &*drawn.envs), (1, &envs[..]));
            assert!(drawn.frames == expected[&drawn.step], "step {}", drawn.step);
            seen += 1;
        }
    }
    // The trainer pauses.
    assert_drawn(&mut pictures, &twin, 1, &envs, last);
    assert_drawn(&mut pictures, &twin, 1, &[2], last);
    // A group that was not reset has no frames.
    pictures.want(0, &[0]).unwrap();
    reset(&mut trainer, 0);
    assert_drawn(&mut pictures, &self::twin(0), 0, &[0, 1, 2, 3, 4], 1);
    drop(pictures);
    assert_eq!(files(&place), [] as [PathBuf; 0]);
}

#[test]
fn environments_are_drawn_whose_batches_have_no_frames() {
    for (id, is_drawn) in [("popgym-RepeatFirstEasy-v0", true), (ID, false)] {
        let arguments = ["--env", id, "--features"];
        let place = Place::new();
        let _engine = place.serve(&arguments);
        let observer = Observer::connect(&place.connect_config("endless"), 0).unwrap();
        assert_eq!(Pictures::of(&observer).unwrap().is_some(), is_drawn, "{arguments:?}");
    }
}

#[test]
fn the_file_of_a_killed_viewer_is_removed() {
    let place = Place::new();
    let _engine = serve(&place);
    let mut trainer = place.trainer("endless").unwrap();
    reset(&mut trainer, 0);
    let mut server = Server::start(place.endless(&["view", "endless"]));
    let mut socket = server.show("endless");
    socket.wait(|about| about["state"] == "live");
    step(&mut trainer, 0);
    socket.wait(|about| about["batch"]["frame"]["width"] == 84);
    assert_eq!(files(&place).len(), 1);
    server.process.kill();
    wait_until("the file is removed", || files(&place).is_empty());
    assert_eq!(step(&mut trainer, 0).step(), 3);
}

/// The file of a viewer that wants these environments, as far as their number is possible.
fn forged(place: &Place, name: u64, magic: &[u8; 8], group: u32, count: u32, envs: &[u32]) -> File {
    let real = files(place).swap_remove(0);
    let (start, _) = real.to_str().unwrap().rsplit_once(".picture").unwrap().0.rsplit_once('.').unwrap();
    let path = format!("{start}.{name:016x}.picture");
    let mut file = File::create_new(format!("{path}.new")).unwrap();
    file.lock().unwrap();
    let numbers: Vec<u8> = [group, count].iter().chain(envs).flat_map(|number| number.to_ne_bytes()).collect();
    file.write_all(&[magic, &*numbers].concat()).unwrap();
    file.write_all(&vec![0; 3000_usize.saturating_sub(8 + numbers.len())]).unwrap();
    fs::rename(format!("{path}.new"), path).unwrap();
    file
}

#[test]
fn faulty_viewers_harm_neither_the_engine_nor_others() {
    let place = Place::new();
    let mut engine = serve(&place);
    let mut trainer = place.trainer("endless").unwrap();
    reset(&mut trainer, 0);
    let (mut good, mut twin) = (pictures(&place), twin(0));
    let magic = b"EGYMPICT";
    let mut forged_files: Vec<File> = [
        (b"OTHERFIL", 0, 1, &[0][..]),
        (magic, 0, 257, &[0]),
        (magic, 0, u32::MAX, &[0]),
        (magic, 2, 1, &[0]),
        (magic, u32::MAX, 1, &[0]),
        (magic, 0, 2, &[0, 5]),
        (magic, 0, 1, &[u32::MAX]),
    ]
    .iter()
    .zip(1..)
    .map(|(&(magic, group, count, envs), name)| forged(&place, name, magic, group, count, envs))
    .collect();
    let unused = forged_files.len();
    // The first two are drawn for; one of them is truncated all the time.
    forged_files.push(forged(&place, 20, magic, 0, 256, &[4; 256]));
    forged_files.push(forged(&place, 21, magic, 0, 1, &[1]));
    forged_files.push(forged(&place, 22, magic, 0, 1, &[1]));
    forged_files[unused + 2].set_len(20).unwrap();
    let start = files(&place)[0].to_str().unwrap().rsplit_once(".picture").unwrap().0.len() - 16;
    let named =
        |name: &str| PathBuf::from(format!("{}{name:0>16}.picture", &files(&place)[0].to_str().unwrap()[..start]));
    fs::create_dir(named("30")).unwrap();
    mknodat(CWD, named("31"), FileType::Fifo, Mode::RUSR | Mode::WUSR, 0).unwrap();
    std::os::unix::fs::symlink("/dev/zero", named("32")).unwrap();
    for number in 2..60 {
        forged_files[unused + 1].set_len([0, 3000, 2050][number as usize % 3]).unwrap();
        assert_eq!(step(&mut trainer, 0).step(), number);
        twin.step_all(1);
        std::thread::sleep(std::time::Duration::from_millis(20));
    }
    assert_drawn(&mut good, &twin, 0, &[3, 1], 59);
    // An environment may be repeated. Nothing is written for wishes that make no sense.
    assert!(forged_files[unused].metadata().unwrap().len() > 256 * FRAME as u64);
    for (number, file) in forged_files[..unused].iter().enumerate() {
        let mut rest = vec![0; 4000];
        let length = file.read_at(&mut rest, 0).unwrap();
        assert!(length == 3000 && rest[2048..].iter().all(|byte| *byte == 0), "file {number} was written to");
    }
    assert!(engine.0.try_wait().unwrap().is_none());
    // Of viewers that have ended, nothing stays.
    fs::remove_dir(named("30")).unwrap();
    fs::remove_file(named("31")).unwrap();
    fs::remove_file(named("32")).unwrap();
    drop(forged_files);
    wait_until("the files are removed", || files(&place).len() == 1);
}
