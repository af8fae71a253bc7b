//! Options that several commands share.

use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};
use endless_gym_core::batch::Frames;
use endless_gym_core::pool::{Autoreset, PoolConfig, ResetOptions, Seeding};
use endless_gym_core::raster::PixelFormat;
use serde_json::{Map, Value as Json};

use super::Failure;

/// The parser of an autoreset mode, with the modes' help.
pub fn autoreset_parser() -> impl TypedValueParser<Value = Autoreset> {
    let values = Autoreset::ALL.map(|mode| PossibleValue::new(mode.name()).help(mode.summary()));
    PossibleValuesParser::new(values).try_map(|name| name.parse::<Autoreset>())
}

/// What the frames are like.
#[derive(clap::Args, Clone, Copy, Debug)]
pub struct FrameArgs {
    /// Leave the frames out, and draw nothing.
    #[arg(long, conflicts_with_all = ["grayscale", "channels_first", "row_major", "frame_stack"])]
    no_frames: bool,
    /// Frames of brightness instead of colours, without an index for the channel.
    #[arg(long)]
    grayscale: bool,
    /// Frames with the channel as their first index.
    #[arg(long)]
    channels_first: bool,
    /// Frames indexed [row][column] instead of [x][y].
    #[arg(long)]
    row_major: bool,
    /// The last N frames of the episode as one observation, oldest first.
    #[arg(long, value_name = "N", default_value_t = 1)]
    frame_stack: usize,
}

impl FrameArgs {
    /// What the batch is to have.
    pub fn frames(self) -> Option<Frames> {
        let FrameArgs { no_frames, grayscale, channels_first, row_major, frame_stack } = self;
        let format = PixelFormat { grayscale, channels_first, row_major };
        (!no_frames).then_some(Frames { format, stack: frame_stack })
    }
}

/// What the environments are like.
#[derive(clap::Args, Clone, Debug)]
pub struct EnvironmentArgs {
    /// Reset parameter of all environments, such as `arena_size=6` or `command_count=[5,10]`; may be given several times.
    #[arg(long = "option", value_name = "NAME=VALUE")]
    options: Vec<String>,
    /// Reset parameters of one environment as a JSON object; given once for each environment of all groups, in their order.
    #[arg(long, value_name = "JSON", conflicts_with = "options")]
    env_options: Vec<String>,
    /// Seed: environment i starts with SEED + i. From the system's entropy if left out.
    #[arg(long)]
    seed: Option<u64>,
    /// Draw each episode's seed from START..END (END excluded), as the paper's training does from 0..100000.
    #[arg(long, value_name = "START..END", value_parser = seed_range)]
    seed_range: Option<(u64, u64)>,
    /// Play these seeds in turn, and again from the start.
    #[arg(long, value_name = "SEED,..", value_delimiter = ',', conflicts_with_all = ["seed", "seed_range"])]
    seed_list: Vec<u64>,
}

fn seed_range(text: &str) -> Result<(u64, u64), String> {
    let (start, end) = text.split_once("..").ok_or("expected START..END")?;
    let number = |text: &str| text.parse::<u64>().map_err(|error| format!("`{text}`: {error}"));
    Ok((number(start)?, number(end)?))
}

impl EnvironmentArgs {
    /// The arguments that say the same to another `endless`.
    pub fn arguments(&self) -> Vec<String> {
        let mut arguments: Vec<String> =
            self.options.iter().flat_map(|option| ["--option".to_owned(), option.clone()]).collect();
        arguments.extend(self.env_options.iter().map(|options| format!("--env-options={options}")));
        arguments.extend(self.seed.map(|seed| format!("--seed={seed}")));
        arguments.extend(self.seed_range.map(|(start, end)| format!("--seed-range={start}..{end}")));
        if !self.seed_list.is_empty() {
            let seeds: Vec<String> = self.seed_list.iter().map(u64::to_string).collect();
            arguments.push(format!("--seed-list={}", seeds.join(",")));
        }
        arguments
    }

    /// A pool's configuration with these options.
    pub fn configure(&self, id: &str, num_envs: usize) -> Result<PoolConfig, Failure> {
        let mut options = Map::new();
        for option in &self.options {
            let (name, value) = option
                .split_once('=')
                .ok_or_else(|| format!("--option {option}: expected NAME=VALUE, such as arena_size=6"))?;
            // What is no JSON is passed on as text, so that the check of the parameter says what it should be.
            let value = serde_json::from_str(value).unwrap_or_else(|_| Json::from(value));
            options.insert(name.to_owned(), value);
        }
        let each = self.env_options.iter().map(|options| {
            serde_json::from_str(options)
                .map_err(|error| format!("--env-options {options}: expected a JSON object: {error}"))
        });
        let each = each.collect::<Result<Vec<_>, _>>()?;
        let options = if each.is_empty() { ResetOptions::Shared(options) } else { ResetOptions::Each(each) };
        let seeding = match (self.seed_range, &self.seed_list[..]) {
            (Some((start, end)), _) => Seeding::Range { start, end, seed: self.seed },
            (None, []) => Seeding::Continue { seed: self.seed },
            (None, list) => Seeding::List(list.to_vec()),
        };
        Ok(PoolConfig { options, seeding, ..PoolConfig::new(id, num_envs) })
    }
}

#[cfg(test)]
mod tests {
    use clap::{Arg, Command};

    use super::*;

    #[test]
    fn autoreset_modes_are_given_by_their_names() {
        let parse = |given: &str| {
            let command = Command::new("endless").arg(Arg::new("mode").value_parser(autoreset_parser()));
            command.try_get_matches_from(["endless", given]).map(|found| found.get_one::<Autoreset>("mode").copied())
        };
        for mode in Autoreset::ALL {
            assert_eq!(parse(mode.name()).unwrap(), Some(mode));
        }
        let message = parse("never").unwrap_err().to_string();
        assert!(Autoreset::ALL.iter().all(|mode| message.contains(mode.name())), "{message}");
    }
}
