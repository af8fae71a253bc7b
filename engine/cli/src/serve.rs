//! `endless serve`.

use std::process::ExitCode;

use endless_gym_core::envs::DEFAULT_ENV_ID;
use endless_gym_core::pool::{Autoreset, PoolConfig, Threads};
use endless_gym_service::{Engine, EngineConfig};

use super::options::{EnvironmentArgs, FrameArgs, autoreset_parser};
use super::output::{grouped, print};
use super::{Failure, stop};

#[derive(clap::Args)]
pub struct Args {
    /// Environment id; `endless list` shows them.
    #[arg(long = "env", value_name = "ID", default_value = DEFAULT_ENV_ID)]
    id: String,
    /// Environments in each group.
    #[arg(long, default_value_t = 1024)]
    num_envs: usize,
    /// Threads that step environments; 0 for one for each core.
    #[arg(long, default_value_t = 0)]
    threads: usize,
    /// Groups that are stepped independently, so that a trainer can work on one while the engine steps another.
    #[arg(long, default_value_t = 1)]
    groups: usize,
    /// Name that trainers connect to.
    #[arg(long, value_name = "NAME", default_value = "endless")]
    service: String,
    #[command(flatten)]
    environment: EnvironmentArgs,
    /// When an episode that ended gives way to the next.
    #[arg(long, value_name = "MODE", value_parser = autoreset_parser(), default_value_t = Autoreset::default())]
    autoreset: Autoreset,
    /// Keep the last observation of episodes that same-step auto-reset ends.
    #[arg(long)]
    final_observation: bool,
    /// Add the feature observation: what a frame shows, in numbers.
    #[arg(long)]
    features: bool,
    #[command(flatten)]
    frames: FrameArgs,
    /// Batches of a group that a trainer may hold at a time.
    #[arg(long, default_value_t = 3)]
    batches_held: usize,
    /// Say nothing, and end when standard input does: for an engine that belongs to the program that started it.
    #[arg(long, hide = true)]
    child: bool,
}

pub fn run(args: &Args) -> Result<ExitCode, Failure> {
    let stop = stop::on_signal()?;
    if args.child {
        stop::on_closed_input(&stop);
    }
    let pool = PoolConfig {
        autoreset: args.autoreset,
        final_observation: args.final_observation,
        frames: args.frames.frames(),
        features: args.features,
        ..args.environment.configure(&args.id, args.num_envs)?
    };
    let mut engine = Engine::new(&EngineConfig {
        groups: args.groups,
        batches_held: args.batches_held,
        ..EngineConfig::new(&args.service, pool, Threads::new(args.threads)?)
    })?;
    if !args.child {
        let (groups, num_envs) = (args.groups, args.num_envs);
        let groups = if groups == 1 { "1 group".to_owned() } else { format!("{groups} groups") };
        print(format_args!(
            "serving {} as `{}`: {groups} of {num_envs} environments; Ctrl-C ends",
            args.id, args.service
        ));
    }
    let summary = engine.run(&stop)?;
    if !args.child {
        print(format_args!(
            "{} steps in {} batches",
            grouped(summary.env_steps as f64),
            grouped(summary.batches as f64)
        ));
    }
    Ok(ExitCode::SUCCESS)
}
