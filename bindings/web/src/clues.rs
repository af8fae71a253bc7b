//! What an episode has shown so far and a player should remember, read from the features by their names: commands and how they were
//! carried out, the tiles of a path, or places of coins and the exit.

use endless_gym_core::envs::EnvSpec;
use serde_json::{Value as Json, json};

/// Prefix of the features that are 1 while a command is shown.
const COMMAND: &str = "command_";

/// Tiles along the screen: of Mortar Mayhem's largest arena, and of Mystery Path.
const ARENA: f32 = 6.0;
const GRID: f32 = 7.0;

/// Shares of the screen's size by which two places of the same coin may differ.
const SAME: f32 = 0.01;

type Tile = (i32, i32);

/// What was seen in an episode.
pub struct Clues {
    columns: Vec<&'static str>,
    /// Whether the arena of the commands is a torus, and the screen scrolls with the agent.
    is_endless: bool,
    seen: Seen,
}

#[derive(Default)]
struct Seen {
    /// The commands that were shown, the one that the last observation showed, and those carried out since.
    commands: Vec<String>,
    visible: Option<usize>,
    carried_out: Vec<String>,
    was_burning: bool,
    /// The tile from which the next command leads.
    from: Option<Tile>,
    /// The tiles of the path, and those beside it, in the order in which they were found.
    walked: Vec<Tile>,
    falls: Vec<Tile>,
    had_fallen: bool,
    /// Share of the screen by which it has scrolled.
    scrolled: f32,
    /// Coins that were seen and not collected, and the exit.
    coins: Vec<[f32; 2]>,
    collected: f64,
    agent: [f32; 2],
    exit: Option<[f32; 2]>,
}

impl Clues {
    pub fn new(spec: &EnvSpec) -> Self {
        let columns = spec.features.iter().map(|column| column.name).collect();
        Clues { columns, is_endless: spec.id.starts_with("Endless-"), seen: Seen::default() }
    }

    /// Forgets the episode.
    pub fn reset(&mut self) {
        self.seen = Seen::default();
    }

    fn number(&self, name: &str, features: &[f32]) -> Option<f32> {
        features.get(self.columns.iter().position(|column| *column == name)?).copied()
    }

    /// Reads an observation, the number of coins that were collected before it, and the share of the screen by which the last action
    /// moves to the right.
    pub fn observe(&mut self, features: &[f32], collected: f64, moved: f32) {
        let number = |name: &str| self.number(name, features);
        let (Some(x), Some(y)) = (number("agent_x"), number("agent_y")) else { return };
        let commands = self.columns.iter().enumerate().filter_map(|(i, name)| Some((i, name.strip_prefix(COMMAND)?)));
        let visible = commands.clone().position(|(index, _)| features.get(index) == Some(&1.0));
        let shown = visible.and_then(|place| commands.clone().nth(place)).map(|(_, name)| name.replace('_', " "));
        let arena = (|| Some((number("burning")?, number("safe_x")?, number("safe_y")?, number("arena_size")?)))();
        let fallen = number("fallen").map(|fallen| fallen == 1.0);
        let coins = (0..).map_while(|coin| {
            let of = |what: &str| number(&format!("coin_{coin}_{what}"));
            Some((of("seen")?, [of("x")?, of("y")?]))
        });
        let coins: Vec<[f32; 2]> = coins.filter_map(|(seen, place)| (seen == 1.0).then_some(place)).collect();
        let exit = number("exit_seen").filter(|seen| *seen == 1.0).and(number("exit_x")).zip(number("exit_y"));
        let agent_seen = number("agent_seen") == Some(1.0);
        let seen = &mut self.seen;

        if let Some((burning, safe_x, safe_y, size)) = arena {
            let size = (size * ARENA).round();
            let tile = [x, y].map(|share| (ARENA * share - (ARENA - size) / 2.0).floor() as i32);
            let from = *seen.from.get_or_insert(tile.into());
            let is_burning = burning == 1.0;
            if is_burning && !seen.was_burning {
                let moved = [tile[0] - from.0, tile[1] - from.1];
                seen.carried_out.push(direction(if self.is_endless {
                    moved.map(|by| wrapped(by, size as i32))
                } else {
                    moved
                }));
                seen.from = Some(((safe_x * 5.0).round() as i32, (safe_y * 5.0).round() as i32));
            }
            seen.was_burning = is_burning;
            if visible != seen.visible
                && let Some(command) = shown
            {
                seen.commands.push(command);
                seen.carried_out.clear();
            }
            seen.visible = visible;
        }
        if let Some(fallen) = fallen {
            // After a fall, the screen is back at the start.
            seen.scrolled = if seen.had_fallen { 0.0 } else { seen.scrolled + moved };
            // The agent starts in the middle of a tile.
            let column = if self.is_endless { 0.5 + GRID * seen.scrolled } else { GRID * x };
            let tile = ((column + 1e-3).floor() as i32, (GRID * y + 1e-3).floor() as i32);
            let tiles = if fallen { &mut seen.falls } else { &mut seen.walked };
            if !tiles.contains(&tile) {
                tiles.push(tile);
            }
            seen.had_fallen = fallen;
        }
        let distance = |a: [f32; 2], b: [f32; 2]| (a[0] - b[0]).hypot(a[1] - b[1]);
        if agent_seen {
            seen.agent = [x, y];
        }
        if collected > seen.collected {
            let nearest = |a: &[f32; 2], b: &[f32; 2]| distance(*a, seen.agent).total_cmp(&distance(*b, seen.agent));
            if let Some(taken) = seen.coins.iter().copied().min_by(nearest) {
                seen.coins.retain(|coin| *coin != taken);
            }
            seen.collected = collected;
        }
        for coin in coins {
            if seen.coins.iter().all(|known| distance(*known, coin) > SAME) {
                seen.coins.push(coin);
            }
        }
        seen.exit = exit.map(|(x, y)| [x, y]).or(seen.exit);
    }

    /// What was seen; null in environments without any of it.
    pub fn seen(&self) -> Json {
        let has = |prefix: &str| self.columns.iter().any(|name| name.starts_with(prefix));
        let seen = &self.seen;
        match () {
            () if has("burning") => json!({"commands": seen.commands, "carried_out": seen.carried_out}),
            () if has("fallen") => json!({"walked": seen.walked, "falls": seen.falls}),
            () if has("coin_") => json!({"coins": seen.coins, "exit": seen.exit}),
            () => Json::Null,
        }
    }
}

/// The shorter way around a torus.
fn wrapped(by: i32, size: i32) -> i32 {
    (by + size / 2).rem_euclid(size.max(1)) - size / 2
}

/// The command that moves by so many tiles, such as `right down`; `elsewhere` for more than one.
fn direction([x, y]: [i32; 2]) -> String {
    let (x, y) = match (x, y) {
        (0, 0) => return "stay".to_owned(),
        (-1..=1, -1..=1) => (["left", "", "right"][(x + 1) as usize], ["up", "", "down"][(y + 1) as usize]),
        _ => return "elsewhere".to_owned(),
    };
    format!("{x} {y}").trim().to_owned()
}
