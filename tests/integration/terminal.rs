//! `endless play --terminal` and `endless view --terminal` in a pseudo-terminal with a terminal emulator.

use std::fs::File;
use std::io::{Read, Write};
use std::process::{Command, Stdio};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use crate::support::place::Place;
use crate::support::player::Player;
use crate::support::process::{Process, TIMEOUT, pseudo_terminal, wait_until};
use endless_gym::pool::{PoolConfig, ResetRequest};
use rustix::process::Signal;
use rustix::termios::{LocalModes, tcgetattr};

const COLUMNS: u16 = 84;
const ROWS: u16 = 48;

/// A program in a terminal.
struct Session {
    process: Process,
    terminal: File,
    screen: Arc<Mutex<vt100::Parser>>,
}

impl Session {
    fn start(command: &mut Command) -> Self {
        Self::sized(command, COLUMNS, ROWS)
    }

    fn sized(command: &mut Command, columns: u16, rows: u16) -> Self {
        let (terminal, program_side) = pseudo_terminal(columns, rows);
        let side = || program_side.try_clone().unwrap();
        let process = Process::spawn(command.stdin(side()).stdout(side()).stderr(side()));
        command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
        let screen = Arc::new(Mutex::new(vt100::Parser::new(rows, columns, 0)));
        let (mut output, written) = (terminal.try_clone().unwrap(), Arc::clone(&screen));
        std::thread::spawn(move || {
            let mut bytes = [0; 4096];
            while let Ok(count @ 1..) = output.read(&mut bytes) {
                written.lock().unwrap().process(&bytes[..count]);
            }
        });
        Session { process, terminal, screen }
    }

    fn press(&mut self, keys: &str) {
        self.terminal.write_all(keys.as_bytes()).unwrap();
    }

    fn contents(&self) -> String {
        self.screen.lock().unwrap().screen().contents()
    }

    /// The text on the screen, in one line.
    fn line(&self) -> String {
        in_one_line(&self.contents())
    }

    /// Waits until the screen shows that text, which may be broken into lines.
    #[track_caller]
    fn wait_for(&self, text: &str) {
        wait_until(text, || self.line().contains(&in_one_line(text)));
    }

    /// The frame-sized picture in the upper left corner, in rows.
    fn picture(&self) -> Vec<[u8; 3]> {
        let parser = self.screen.lock().unwrap();
        let pixel = |place: u16| {
            let cell = parser.screen().cell(place / 84 / 2, place % 84).unwrap();
            match if (place / 84).is_multiple_of(2) { cell.fgcolor() } else { cell.bgcolor() } {
                vt100::Color::Rgb(r, g, b) => [r, g, b],
                other => panic!("pixel {place} is {other:?}"),
            }
        };
        (0..84 * 84).map(pixel).collect()
    }

    /// Whether the terminal is restored for a shell: line mode with echo, outside the alternate screen.
    fn is_left(&self) -> bool {
        let modes = tcgetattr(&self.terminal).unwrap().local_modes;
        let has_lines = modes.contains(LocalModes::ICANON | LocalModes::ECHO);
        let parser = self.screen.lock().unwrap();
        assert_eq!(has_lines, !parser.screen().alternate_screen());
        has_lines && !parser.screen().hide_cursor()
    }

    fn end(&mut self) -> Option<i32> {
        let status = self.process.wait();
        // Its last output may not have been read yet.
        std::thread::sleep(Duration::from_millis(300));
        assert!(self.is_left(), "{}", self.contents());
        status.code()
    }
}

fn in_one_line(text: &str) -> String {
    let mut line = String::new();
    for character in text.chars() {
        let character = if character.is_whitespace() { ' ' } else { character };
        if character != ' ' || !line.ends_with(' ') {
            line.push(character);
        }
    }
    line
}

/// The observation of an episode after these actions, in rows.
fn frame(id: &str, seed: u64, actions: &[&[i32]]) -> Vec<[u8; 3]> {
    let mut player = Player::new(&PoolConfig::new(id, 1));
    player.reset(ResetRequest::Seed(seed));
    actions.iter().for_each(|action| player.step(action));
    let observation = player.batch().observation().as_chunks::<3>().0;
    (0..84 * 84).map(|place| observation[place % 84 * 84 + place / 84]).collect()
}

#[test]
fn a_game_is_played_with_keys() {
    let place = Place::new();
    let id = "MysteryPath-Grid-v0";
    let mut session = Session::start(&mut place.endless(&["play", id, "--terminal", "--seed", "3", "--fps", "1"]));
    session.wait_for("seed 3  step 0  reward 0.000  return 0.000 waits for the first key");
    assert!(!session.is_left());
    session.press(" ");
    session.wait_for("step 1 ");
    session.press(" ");
    session.wait_for("paused");
    session.press("r");
    session.wait_for("step 0 ");
    assert!(session.picture() == frame(id, 3, &[]));
    // Up with an arrow key, left with the letter key.
    session.press("\x1b[A");
    session.wait_for("step 1 ");
    session.press("a");
    session.wait_for("step 2 ");
    assert!(session.picture() == frame(id, 3, &[&[3], &[1]]));
    assert!(frame(id, 3, &[&[3], &[1]]) != frame(id, 3, &[&[0], &[0]]));
    session.press("n");
    session.wait_for("step 3 ");
    session.press("\x1b[5~");
    session.wait_for("seed 4  step 0 ");
    assert!(session.picture() == frame(id, 4, &[]));
    session.press(&"\x1b[6~".repeat(6));
    session.wait_for("seed 0 ");
    session.press(" ");
    session.wait_for("step 1 ");
    session.press("\x1b");
    assert_eq!(session.end(), Some(0));
}

#[test]
fn every_kind_of_action_is_played_with_keys_in_a_narrow_terminal() {
    let place = Place::new();
    let play = |id: &str| {
        let session = Session::sized(&mut place.endless(&["play", id, "--terminal", "--fps", "10"]), 70, 24);
        session.wait_for("Esc quits");
        session
    };
    let mut named = play("popgym-RepeatFirstEasy-v0");
    assert!(
        named.line().contains(
            "digits play 0 spades 1 diamonds 2 clubs 3 hearts, Enter plays the number in brackets, R restarts"
        )
    );
    named.press("2");
    named.wait_for("step 1 ");
    named.press("\r");
    named.wait_for("step 2 ");
    let suits = ["spades", "diamonds", "clubs", "hearts"].map(|suit| format!("suit {suit}"));
    assert!(suits.iter().any(|suit| named.contents().contains(suit)));
    named.press("q");
    assert_eq!(named.end(), Some(0));
    let mut board = play("popgym-BattleshipMedium-v0");
    board.press("3\t9");
    board.wait_for("action 0 3  [action 1 9]");
    assert!(board.line().contains("step 0 "), "{}", board.line());
    board.press("\r");
    board.wait_for("step 1 ");
    let mut many = play("popgym-ConcentrationEasy-v0");
    many.press("41");
    many.wait_for("[action 41]");
    many.press("\r");
    many.wait_for("step 1 ");
    assert!(!many.line().contains("card_41 2"), "the card has been turned over");
    let mut torque = play("popgym-PositionOnlyPendulumEasy-v0");
    torque.wait_for("waits for the first key");
    torque.press("\x1b[C\x1b[C");
    torque.wait_for("[action 0.40 in -2 to 2]");
    torque.wait_for("step 3 ");
    let mut pole = play("popgym-PositionOnlyCartPoleEasy-v0");
    pole.press("d");
    pole.wait_for("step 1 ");
    let both = play("MortarMayhem-v0");
    assert!(
        both.line()
            .contains("arrows or W A S D move, Q E Z C diagonally, Space pauses, N one step, R restarts, PgUp/PgDn")
    );
    for mut session in [named, board, many, torque, pole, both] {
        session.press("\x1b");
        assert_eq!(session.end(), Some(0));
    }
}

/// Starts a program in a terminal, closes the terminal's window once it shows a text, and checks that the program ends.
#[track_caller]
fn ends_without_its_terminal(command: &mut Command, text: &str, keys: &str) {
    let (mut terminal, program_side) = pseudo_terminal(COLUMNS, ROWS);
    let side = || program_side.try_clone().unwrap();
    let mut process = Process::spawn(command.stdin(side()).stdout(side()).stderr(side()));
    command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
    drop(program_side);
    terminal.write_all(keys.as_bytes()).unwrap();
    let (mut screen, mut bytes) = (vt100::Parser::new(ROWS, COLUMNS, 0), [0; 4096]);
    while !in_one_line(&screen.screen().contents()).contains(text) {
        let count = terminal.read(&mut bytes).unwrap();
        screen.process(&bytes[..count]);
    }
    drop(terminal);
    assert_eq!(process.wait().code(), Some(0), "{text}");
}

#[test]
fn a_game_and_a_view_end_when_their_terminal_goes_away() {
    let place = Place::new();
    let play = ["play", "MysteryPath-v0", "--terminal"];
    ends_without_its_terminal(&mut place.endless(&play), "waits for the first key", "");
    ends_without_its_terminal(&mut place.endless(&play), "step 3 ", "w");
    ends_without_its_terminal(&mut place.endless(&play), "paused", "n");
    let _engine = place.serve(&["--env", "MysteryPath-v0", "--num-envs", "1"]);
    let view = ["view", "--terminal", "--timeout", "20"];
    ends_without_its_terminal(&mut place.endless(&view), "no trainer has stepped", "");
}

#[test]
fn the_terminal_is_restored_after_signals() {
    let place = Place::new();
    for (given, name) in [(Signal::TERM, "TERM"), (Signal::HUP, "HUP")] {
        let mut session = Session::start(&mut place.endless(&["play", "--terminal"]));
        session.wait_for("MortarMayhem-v0");
        assert!(!session.is_left());
        session.process.signal(given);
        assert_eq!(session.end(), Some(0), "{name}");
    }
    let mut session = Session::start(&mut place.endless(&["play", "--terminal"]));
    session.wait_for("MortarMayhem-v0");
    session.press("\x03");
    assert_eq!(session.end(), Some(0));
}

#[test]
fn a_training_is_viewed_until_the_engine_ends() {
    let place = Place::new();
    let id = "SearingSpotlights-v0";
    for observation in [&["--no-frames", "--features"][..], &[]] {
        views_until_the_engine_ends(&place, id, observation);
    }
}

fn views_until_the_engine_ends(place: &Place, id: &str, observation: &[&str]) {
    let arguments = [&["--env", id, "--num-envs", "1", "--seed", "5"], observation].concat();
    let mut engine = place.serve(&arguments);
    let mut trainer = place.trainer("endless").unwrap();
    let mut session = Session::start(&mut place.endless(&["view", "--terminal", "--timeout", "20"]));
    session.wait_for("no trainer has stepped");
    trainer.reset(0, ResetRequest::All).unwrap();
    trainer.receive(0, TIMEOUT).unwrap();
    session.wait_for("1 of 1 environments are shown");
    session.wait_for(&format!("endless {id}: "));
    wait_until("the frame is shown", || session.picture() == frame(id, 5, &[]));
    engine.kill();
    session.wait_for("the engine has ended; Q, Esc or Ctrl-C quits");
    assert!(!session.is_left());
    session.press("q");
    assert_eq!(session.end(), Some(0));
    session.wait_for("the engine has ended");
}
