//! A trainer in Rust: proximal policy optimisation with a recurrent memory, on the features of the environments.
//!
//! It is the program `endless learn`, and a chapter to read: [`learn`] below is the whole run, and calls, in this order,
//!
//! | module | contents |
//! | --- | --- |
//! | [`settings`] | the settings, with their defaults and checks |
//! | `run_folder` | the folder of a run and its lock |
//! | [`environments`] | groups of environments, in this process or served by an engine |
//! | [`network`] | the network, forward and backward |
//! | `rollout` | playing: segments of steps |
//! | `update` | learning from a segment, by the `minibatches` of sequences |
//! | [`checkpoint`], `logs`, `metrics` | what a run writes |
//!
//! What the Python agents define has the same names here, and the same numbers up to rounding: settings, columns of `progress.jsonl`,
//! weights. Each reads the other's weights.

#![deny(unsafe_code)]
#![expect(clippy::missing_errors_doc, reason = "one line says what a section would")]

pub mod checkpoint;
pub mod environments;
pub mod error;
mod logs;
mod metrics;
mod minibatches;
pub mod network;
mod rollout;
mod run_folder;
mod served;
pub mod settings;
mod threads;
mod update;

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use checkpoint::Checkpoint;
use endless_gym_core::files;
use endless_gym_kernels::network::Network;
use environments::Environments;
use error::{Error, file};
use logs::{Logger, PROGRESS, print};
use rollout::{Clock, Player, Purpose, RECENT, State, generator};
use run_folder::RunFolder;
use settings::{SETTINGS, Settings};
use threads::Threads;
use update::Learner;

/// Trains an agent in a new run, or resumes one from its last checkpoint. A run that ended before its first one starts again. Returns the
/// folder of the run.
///
/// # Arguments
///
/// - `settings`: the settings, with those of the run to resume as defaults; see [`settings::with_defaults`]
/// - `environments`: makes the environments of the settings, once they are known to be valid
/// - `stop`: when it is set, the run stops after the current update, with a checkpoint
///
/// After [`Error::Diverged`], the last checkpoint is from before. If the environments fail, the run is saved as it was after the last
/// update, which is [`Error::Saved`].
pub fn learn(
    settings: &Settings,
    environments: impl FnOnce(&Settings) -> Result<Environments, Error>,
    stop: &AtomicBool,
) -> Result<PathBuf, Error> {
    let settings = settings.clone().validated()?;
    let folder = RunFolder::open(&settings)?;
    let run = &*folder.path;
    let is_resumed = !settings.resume.is_empty();
    if is_resumed {
        settings.check_resumable(&settings::read(run)?)?;
    }
    // The first checkpoint is older than the first row.
    let has_begun = checkpoint::exists(run) || fs::metadata(run.join(PROGRESS)).is_ok_and(|rows| rows.len() > 0);
    let resumed = (is_resumed && has_begun).then(|| Checkpoint::read(run)).transpose()?;
    if let Some(checkpoint) = &resumed {
        checkpoint.check(&settings)?;
    }
    let is_new = resumed.is_none();
    let num_envs = settings.environment.num_envs;
    let (threads, started) = (Threads::new(settings.threads)?, Instant::now());
    let environments = environments(&settings)?;
    let mut kept = Settings { resume: String::new(), run: run.to_string_lossy().into_owned(), ..settings.clone() };
    kept.environment.wrapper.clone_from(&environments.wrapper);
    let mut random = generator(settings.seed, Purpose::Weights, 0);
    let mut network = network::new(&settings, environments.observation_width(), environments.choices(), &mut random);
    let mut learner = Learner::new(network.parameters.len());
    let mut player = Player::new(&settings, &network, &threads, environments)?;
    let (mut update, mut steps) = (0, 0);
    if let Some(checkpoint) = resumed {
        let state;
        (update, steps, state) = checkpoint.resume(&mut network, &mut learner.optimizer, num_envs)?;
        player.restore(state)?;
    } else if !settings.init_from.is_empty() {
        print(Checkpoint::read(Path::new(&settings.init_from))?.start(&mut network)?);
    }
    // Written only after everything above has succeeded. A resumed run keeps its changed settings.
    let mut logger = Logger::open(run, settings.ppo.updates, update)?;
    let text = serde_json::to_string_pretty(&kept).map_err(Error::json(SETTINGS))?;
    files::replace(&run.join(SETTINGS), (text + "\n").as_bytes()).map_err(file(&run.join(SETTINGS)))?;
    let save = |counts, network: &Network, learner: &Learner, state: &State, keep: bool| {
        checkpoint::save(run, &kept, counts, network, &learner.optimizer, state, keep)
    };
    let mut state = player.state()?;
    if is_new {
        save((update, steps), &network, &learner, &state, settings.keep_checkpoints)?;
    }
    let (mut saved, mut saved_at) = (update, Instant::now());
    let (env, parameters, threads_count) = (&settings.env, network.parameters.len(), threads.count);
    let place = format!("{parameters} parameters, {threads_count} threads, in {}", run.display());
    print(format_args!("{env}: {place}; Ctrl-C stops the run"));

    let (mut longest, mut saving) = (Duration::ZERO, Duration::ZERO);
    let mut reason = None;
    let mut is_done = update >= settings.ppo.updates;
    while !is_done {
        let (begin, mut clock) = (Instant::now(), Clock::default());
        // The weights are still those with which the segment began, so a failed engine loses nothing but the segment.
        state = match player.collect(&network, &threads, update, &mut clock).and_then(|()| player.state()) {
            Ok(state) => state,
            Err(error) => {
                // Saving comes first, and the engine's error says more than those of the log.
                let _ = logger.sync();
                save((update, steps), &network, &learner, &state, false)?;
                return Err(Error::Saved { error: Box::new(error), update, run: run.to_owned() });
            }
        };
        let learning = Instant::now();
        let mut random = generator(settings.seed, Purpose::Minibatches, update);
        let metrics = learner.learn(&mut network, &player.segment, &settings, update, &mut random, &threads);
        clock.learning = learning.elapsed();
        let of = |name: &str| metrics.iter().find(|(found, _)| *found == name).map_or(f64::NAN, |(_, value)| *value);
        update += 1;
        if let Some(what) = ["loss", "gradient_norm", "weight_norm"].into_iter().find(|name| !of(name).is_finite()) {
            let (learning_rate, max_gradient_norm) = (of("learning_rate"), settings.ppo.max_gradient_norm);
            let (run, value) = (run.to_owned(), of(what));
            return Err(Error::Diverged { update, what, value, learning_rate, max_gradient_norm, run, saved });
        }
        let new_steps = player.segment.values.len() as u64;
        steps += new_steps;
        let recent = metrics::means(player.episodes().iter());
        let all: Vec<_> =
            recent.iter().cloned().chain(metrics.iter().map(|(name, value)| ((*name).to_owned(), *value))).collect();
        logger.update(update, steps, new_steps as f64 / begin.elapsed().as_secs_f64(), &all, clock)?;

        if player.episodes().len() == RECENT {
            let reward = metrics::value(&recent, "episode/reward");
            reason = match settings.target_reward {
                Some(target) => (reward >= target).then(|| format!("the mean reward is {reward:.3}")),
                None if settings.stop_when_learnt => metrics::learnt(&player.environments.spec, &recent)
                    .map(|reason| format!("the task is learnt: {reason}; train longer with --no-stop-when-learnt")),
                None => None,
            };
        }
        longest = longest.max(begin.elapsed());
        let minutes = |minutes: f64| Duration::try_from_secs_f64(60.0 * minutes).unwrap_or(Duration::MAX);
        let is_late = |limit: f64, time: Duration| limit > 0.0 && time >= minutes(limit);
        // Time for a checkpoint now, another update, and the last checkpoint.
        let is_over = is_late(settings.time_limit, started.elapsed() + longest + 2 * saving);
        let is_stopped = stop.load(Ordering::Relaxed) || reason.is_some() || is_over;
        is_done = is_stopped || update >= settings.ppo.updates;
        let is_planned = is_done || update % settings.checkpoint_interval == 0;
        if is_planned || is_late(settings.checkpoint_minutes, saved_at.elapsed()) {
            let begin = Instant::now();
            logger.sync()?;
            save((update, steps), &network, &learner, &state, settings.keep_checkpoints && is_planned)?;
            (saved, saved_at, saving) = (update, Instant::now(), begin.elapsed());
        }
    }
    if let Some(reason) = reason {
        print(reason);
    }
    let (updates, run, connect) = (settings.ppo.updates, run.display(), &settings.connect);
    let connect = if connect.is_empty() { String::new() } else { format!(" --connect {connect}") };
    let (verb, more) = match update < updates {
        true => ("continue", String::new()),
        false => ("train longer", format!(" --ppo.updates {}", 2 * update)),
    };
    print(format_args!("{update} of {updates} updates done; {verb} with: endless learn --resume {run}{connect}{more}"));
    Ok(folder.path.clone())
}
