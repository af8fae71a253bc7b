//! Arguments that several commands share.

use std::any::TypeId;
use std::ffi::OsString;
use std::time::Duration;

use clap::Command;
use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};
use endless_gym_core::batch::Frames;
use endless_gym_core::pool::{Autoreset, OptionMap, PoolConfig, ResetOptions, Seeding};
use endless_gym_core::raster::PixelFormat;
use serde_json::{Map, Value as Json};

use crate::failure::Failure;

/// The value of `--autoreset` for a mode: the mode's name with hyphens.
pub fn autoreset_value(mode: Autoreset) -> String {
    mode.name().replace('_', "-")
}

/// The parser of `--autoreset`, with the help of each mode. Also accepts the mode's name with an underscore.
pub fn autoreset_parser() -> impl TypedValueParser<Value = Autoreset> {
    let value = |mode: Autoreset| PossibleValue::new(autoreset_value(mode)).alias(mode.name()).help(mode.summary());
    PossibleValuesParser::new(Autoreset::ALL.map(value)).try_map(|text| text.replace('-', "_").parse::<Autoreset>())
}

/// The format of frames.
#[derive(clap::Args, Clone, Copy, Debug)]
pub struct FrameArgs {
    /// Draw and write no frames [default: RGB frames, uint8 (84, 84, 3), indexed `[x][y][channel]`].
    #[arg(long, conflicts_with_all = ["grayscale", "channels_first", "row_major", "frame_stack"])]
    no_frames: bool,
    /// Grayscale frames without a channel axis [default: RGB].
    #[arg(long)]
    grayscale: bool,
    /// Frames with the channel as the first axis [default: the last axis].
    #[arg(long)]
    channels_first: bool,
    /// Frames indexed `[row][column]` [default: `[x][y]`].
    #[arg(long)]
    row_major: bool,
    /// Stack the last N frames of the episode in one observation, oldest first: 1 to 64.
    #[arg(long, value_name = "N", default_value_t = 1)]
    frame_stack: usize,
}

impl FrameArgs {
    /// The frames of a batch; `None` for none.
    pub fn frames(self) -> Option<Frames> {
        let FrameArgs { no_frames, grayscale, channels_first, row_major, frame_stack } = self;
        let format = PixelFormat { grayscale, channels_first, row_major };
        (!no_frames).then_some(Frames { format, stack: frame_stack })
    }
}

/// Reset parameters and seeds.
#[derive(clap::Args, Clone, Debug)]
pub struct EnvironmentArgs {
    /// Reset parameter of all environments, such as `arena_size=6` or `command_count=[5,10]`; may be repeated [default: the
    /// environment's own, which `endless list ID` shows].
    #[arg(long = "option", value_name = "NAME=VALUE")]
    options: Vec<String>,
    /// Reset parameters of one environment as a JSON object; repeated for every environment of all groups, in order [default: those
    /// of `--option` for all environments].
    #[arg(long, value_name = "JSON", conflicts_with = "options")]
    env_options: Vec<String>,
    /// Seed: environment i, counted over all groups, is seeded with SEED + i [default: entropy of the operating system].
    #[arg(long)]
    seed: Option<u64>,
    /// Draw the seed of each episode from START to END - 1 in steps of STEP [default: 1]; the paper trains with
    /// 0..100000. `--seed` seeds the draws [default: episodes continue the generator of their environment].
    #[arg(long, value_name = "START..END[:STEP]", value_parser = seed_range)]
    seed_range: Option<SeedRange>,
    /// Seeds of successive episodes, starting over at the end of the list [default: as for `--seed-range`].
    #[arg(long, value_name = "SEED,..", value_delimiter = ',', conflicts_with_all = ["seed", "seed_range"])]
    seed_list: Vec<u64>,
    /// Make episodes depend only on their seed and reset parameters [default: as in the original, some show leftovers
    /// of an earlier episode and continue its generator].
    #[arg(long)]
    independent_episodes: bool,
    /// Number of the first environment, for seeds, if one trainer uses several engines.
    #[arg(long, value_name = "N", default_value_t = 0)]
    first_env: usize,
    /// Environments of all engines together [default: --first-env plus those of this engine].
    #[arg(long, value_name = "N")]
    total_envs: Option<usize>,
}

/// First seed, end and step.
type SeedRange = (u64, u64, u64);

/// Parses `START..END` or `START..END:STEP`.
fn seed_range(text: &str) -> Result<SeedRange, String> {
    let (start, end) = text.split_once("..").ok_or("expected START..END or START..END:STEP")?;
    let (end, step) = end.split_once(':').unwrap_or((end, "1"));
    let number = |text: &str| text.parse::<u64>().map_err(|error| format!("`{text}`: {error}"));
    Ok((number(start)?, number(end)?, number(step)?))
}

impl EnvironmentArgs {
    /// The configuration of a pool with these arguments.
    pub fn configure(&self, id: &str, num_envs: usize) -> Result<PoolConfig, Failure> {
        let options = parameters(&self.options)?;
        let each = self.env_options.iter().map(|options| {
            serde_json::from_str(options)
                .map_err(|error| format!("--env-options {options}: expected a JSON object: {error}"))
        });
        let each = each.collect::<Result<Vec<_>, _>>()?;
        let options = if each.is_empty() { ResetOptions::Shared(options) } else { ResetOptions::Each(each) };
        let seeding = match (self.seed_range, &self.seed_list[..]) {
            (Some((start, end, step)), _) => Seeding::Range { start, end, step, seed: self.seed },
            (None, []) => Seeding::Continue { seed: self.seed },
            (None, list) => Seeding::List(list.to_vec()),
        };
        let EnvironmentArgs { independent_episodes, first_env, .. } = *self;
        let total_envs = self.total_envs.unwrap_or(first_env.saturating_add(num_envs));
        let new = PoolConfig::new(id, num_envs);
        Ok(new
            .options(options)
            .seeding(seeding)
            .independent_episodes(independent_episodes)
            .first_env(first_env)
            .total_envs(total_envs))
    }
}

/// The reset parameters of the arguments `--option NAME=VALUE`.
pub fn parameters(given: &[String]) -> Result<OptionMap, Failure> {
    let mut options = Map::new();
    for option in given {
        let (name, value) = option
            .split_once('=')
            .ok_or_else(|| format!("--option {option}: expected NAME=VALUE, such as arena_size=6"))?;
        // Text that is not JSON is passed on as a string; the check of the parameter then reports the allowed values.
        let value = serde_json::from_str(value).unwrap_or_else(|_| Json::from(value));
        options.insert(name.to_owned(), value);
    }
    Ok(options)
}

/// The arguments with numbers as Rust reads them: without the `_` between digits that Python allows, as in `1_000_000`. The values of
/// options that are texts stay.
pub fn plain_numbers(command: &Command, mut arguments: Vec<OsString>) -> Vec<OsString> {
    let subcommand = arguments.iter().skip(1).find_map(|argument| command.find_subcommand(argument)).unwrap_or(command);
    let numbers = [
        TypeId::of::<u8>(),
        TypeId::of::<u16>(),
        TypeId::of::<u32>(),
        TypeId::of::<u64>(),
        TypeId::of::<usize>(),
        TypeId::of::<f64>(),
        TypeId::of::<SeedRange>(),
    ];
    let is_number = |name: &str| {
        let mut options = subcommand.get_arguments();
        let option = options.find(|option| option.get_long() == Some(name));
        option.is_some_and(|option| numbers.iter().any(|number| option.get_value_parser().type_id() == *number))
    };
    let mut is_value = false;
    for argument in &mut arguments {
        let Some(text) = argument.to_str() else { continue };
        let (name, value) = text.split_once('=').map_or((text, None), |(name, value)| (name, Some(value)));
        let name = name.strip_prefix("--");
        let plain = match (name, value) {
            (Some(name), Some(value)) if is_number(name) => Some(format!("--{name}={}", without_separators(value))),
            (None, _) if is_value => Some(without_separators(text)),
            _ => None,
        };
        is_value = value.is_none() && name.is_some_and(is_number);
        if let Some(plain) = plain {
            *argument = plain.into();
        }
    }
    arguments
}

/// A text without each `_` between two digits.
fn without_separators(text: &str) -> String {
    let is_digit = |at: usize| text.as_bytes().get(at).is_some_and(u8::is_ascii_digit);
    let is_kept = |at: usize, c| c != '_' || at == 0 || !is_digit(at - 1) || !is_digit(at + 1);
    text.char_indices().filter(|(at, c)| is_kept(*at, *c)).map(|(_, c)| c).collect()
}

/// The duration that the argument `name` gives in seconds.
pub fn seconds(name: &str, given: f64) -> Result<Duration, Failure> {
    match Duration::try_from_secs_f64(given) {
        Ok(duration) if given > 0.0 => Ok(duration),
        _ => Err(format!("{name} must be finite and positive, got {given}").into()),
    }
}

#[cfg(test)]
mod tests {
    use clap::{Arg, Args};

    use super::*;

    #[test]
    fn only_numbers_lose_their_separators() {
        let command = EnvironmentArgs::augment_args(Command::new("serve")).arg(Arg::new("file").long("file"));
        let command = Command::new("endless").subcommand(command);
        for (given, expected) in [
            ("--seed 1_000 --seed=2_000", "--seed 1000 --seed=2000"),
            ("--seed-range 0..100_000:1_0 --seed-list 1_0,2_0", "--seed-range 0..100000:10 --seed-list 10,20"),
            ("--seed _1 --seed 1_ --seed 1__0", "--seed _1 --seed 1_ --seed 1__0"),
            ("--file 1_000 --option a=1_0 1_0 --seed", "--file 1_000 --option a=1_0 1_0 --seed"),
        ] {
            let arguments = format!("endless serve {given}").split(' ').map(OsString::from).collect();
            let plain: Vec<_> = plain_numbers(&command, arguments).into_iter().skip(2).collect();
            assert_eq!(plain, expected.split(' ').collect::<Vec<_>>(), "{given}");
        }
    }

    #[test]
    fn autoreset_modes_are_parsed_from_both_spellings() {
        let parse = |given: &str| {
            let command = Command::new("endless").arg(Arg::new("mode").value_parser(autoreset_parser()));
            command.try_get_matches_from(["endless", given]).map(|found| found.get_one::<Autoreset>("mode").copied())
        };
        for mode in Autoreset::ALL {
            assert_eq!(parse(mode.name()).unwrap(), Some(mode));
            assert_eq!(parse(&autoreset_value(mode)).unwrap(), Some(mode));
        }
        let message = parse("never").unwrap_err().to_string();
        assert!(Autoreset::ALL.iter().all(|mode| message.contains(&autoreset_value(*mode))), "{message}");
    }
}
