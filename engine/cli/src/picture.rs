//! A small picture of an environment, as coloured characters.

use std::io::{self, IsTerminal};

use clap::ColorChoice;
use endless_gym_core::envs::EnvSpec;
use endless_gym_core::envs::view::Picture;
use endless_gym_core::pool::{PoolConfig, Registry, Seeding};

use crate::failure::Failure;
use crate::film::Film;
use crate::policies::Policy;
use crate::terminal::picture::Pixels;

/// Whether to print a picture to standard output.
pub fn applies(when: ColorChoice) -> bool {
    let variable = |name| std::env::var(name).unwrap_or_default();
    let has_colours = || {
        io::stdout().is_terminal()
            && matches!(&*variable("COLORTERM"), "truecolor" | "24bit")
            && variable("NO_COLOR").is_empty()
    };
    when == ColorChoice::Always || (when == ColorChoice::Auto && has_colours())
}

/// Pixels of the picture in each direction. A character shows two of them, one above the other.
const SIDE: usize = 42;

/// Spaces between two pictures.
const GAP: usize = 2;

/// The seed of the episode shown, which is long enough in every environment.
const SEED: u64 = 15;

/// A step that shows what the environment is about: a command, the path, the spotlights.
const TYPICAL_STEP: usize = 12;

/// The ground-truth view at a typical step of an episode, in 42 columns and 22 lines; next to the observation if 86
/// columns are available. The expert plays the episode, or random actions if there is no expert.
pub fn picture(registry: &Registry, spec: &EnvSpec, columns: u16) -> Result<String, Failure> {
    let config = PoolConfig::new(spec.id, 1).seeding(Seeding::Continue { seed: Some(SEED) });
    let policy = if registry.expert(spec.id).is_ok() { Policy::Expert } else { Policy::Random };
    let mut film = Film::new(registry, &config, policy, 0)?;
    for _ in 0..TYPICAL_STEP {
        film.step()?;
    }
    let reduced = |picture: &Picture| Pixels::from(picture).resized(SIDE);
    // Without frames, both are the same picture.
    let mut pictures = Vec::new();
    if spec.frame.is_none() || usize::from(columns) >= 2 * SIDE + GAP {
        pictures.push(("observation", reduced(&film.observation()?)));
    }
    if spec.frame.is_some() {
        pictures.push(("ground truth", reduced(&film.ground_truth_view()?)));
    }
    Ok(half_blocks(&pictures))
}

/// Pictures side by side, below their titles: the upper half of a character in its foreground colour, the lower half in its
/// background colour.
fn half_blocks(pictures: &[(&str, Pixels)]) -> String {
    let mut lines = vec![pictures.iter().map(|(title, _)| format!("{title:<SIDE$}")).collect::<Vec<_>>()];
    for row in (0..SIDE).step_by(2) {
        let rows = pictures.iter().map(|(_, picture)| &picture.pixels[row * SIDE..][..2 * SIDE]);
        lines.push(rows.map(half_block_line).collect());
    }
    let gap = " ".repeat(GAP);
    lines.iter().map(|line| line.join(&gap).trim_end().to_owned() + "\n").collect()
}

/// One line of characters, for two rows of pixels.
fn half_block_line(rows: &[[u8; 3]]) -> String {
    let (upper, lower) = rows.split_at(SIDE);
    let (mut line, mut last) = (String::new(), None);
    for colours @ ([r, g, b], [below_r, below_g, below_b]) in upper.iter().zip(lower) {
        if last.replace(colours) != Some(colours) {
            line += &format!("\x1b[38;2;{r};{g};{b};48;2;{below_r};{below_g};{below_b}m");
        }
        line.push('▀');
    }
    line + "\x1b[0m"
}

#[cfg(test)]
mod tests {
    use super::*;
    use endless_gym_memory_gym::memory_gym;

    #[test]
    fn a_line_shows_two_rows_and_sets_each_colour_once() {
        let mut rows = [[0; 3]; 2 * SIDE];
        rows[SIDE + 1] = [1, 2, 3];
        let line = half_block_line(&rows);
        let black = "\x1b[38;2;0;0;0;48;2;0;0;0m";
        let rest = "▀".repeat(SIDE - 2);
        assert_eq!(line, format!("{black}▀\x1b[38;2;0;0;0;48;2;1;2;3m▀{black}{rest}\x1b[0m"));
    }

    #[test]
    fn every_environment_has_a_picture() {
        for spec in memory_gym().specs() {
            let narrow = picture(memory_gym(), spec, 80).unwrap();
            let wide = picture(memory_gym(), spec, (2 * SIDE + GAP) as u16).unwrap();
            assert_eq!(narrow.matches('▀').count(), SIDE * SIDE / 2, "{}", spec.id);
            assert_eq!(wide.matches('▀').count(), SIDE * SIDE, "{}", spec.id);
            let colours: std::collections::BTreeSet<&str> = narrow.split('▀').collect();
            assert!(colours.len() > 5, "{}: {colours:?}", spec.id);
        }
    }
}
