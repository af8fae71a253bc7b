//! The pool: environments, threads, and the buffers that they write into.

use std::sync::Arc;

use super::autoreset::Autoreset;
use super::buffers::Buffers;
use super::config::{EnvReset, OptionMap, PoolConfig, ResetRequest};
use super::drawn_scene::{DrawSettings, FrameFormat};
use super::env_panic::{EnvPanic, catch};
use super::episodes::{NextOptions, RunningEpisode};
use super::error::PoolError;
use super::registry::{Entry, Registry};
use super::seeding::PoolEntropy;
use super::snapshot::{ResumeError, SavedEnv, SnapshotError};
use super::threads::Threads;
use super::typed_envs::{AnyEnvs, WriteContext};
use crate::batch::{BatchMut, Block, Layout, batch_layout};
use crate::envs::view::Picture;
use crate::envs::{EnvSpec, Progress};

/// Environments of one id, stepped in lockstep.
///
/// Every call that advances the environments writes a batch of [`Layout::blocks`] blocks into the caller's memory. In a buffer
/// that the pool has written before, it writes only the pixels that changed.
///
/// ```
/// use endless_gym_core::batch::{Batch, zeroed};
/// use endless_gym_memory_gym::memory_gym;
/// use endless_gym_core::pool::{Pool, PoolConfig, ResetRequest, Threads};
///
/// let mut pool = Pool::new(memory_gym(), &PoolConfig::new("MysteryPath-Grid-v0", 8), &Threads::new(1)?)?;
/// let mut blocks = zeroed(pool.layout().blocks());
/// pool.reset(ResetRequest::Seed(1), &mut blocks)?;
///
/// let actions = vec![0; 8 * pool.spec().action_space.width()];
/// for _ in 0..10 {
///     pool.step(&actions, &mut blocks)?;
/// }
/// let batch = Batch::new(pool.layout(), &blocks);
/// assert_eq!(batch.episode_length(), [10; 8]);
/// assert_eq!(batch.observation().len(), 8 * 84 * 84 * 3);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub struct Pool {
    entry: Arc<Entry>,
    layout: Layout,
    envs: Box<dyn AnyEnvs>,
    buffers: Buffers,
    frame: FrameFormat,
    check_drawing: bool,
    autoreset: Autoreset,
    threads: Threads,
    first_env: usize,
    was_reset: bool,
}

impl Pool {
    /// Creates the environments. [`reset`](Pool::reset) starts their first episodes.
    ///
    /// # Errors
    ///
    /// [`PoolError`] if the id is unknown, or if a reset parameter or a number in `config` is out of range.
    pub fn new(registry: &Registry, config: &PoolConfig, threads: &Threads) -> Result<Self, PoolError> {
        let entry = registry.entry(&config.id)?;
        config.check(&entry.spec)?;
        let layout = batch_layout(&entry.spec, config.num_envs, config.contents())?;
        let entropy = PoolEntropy::draw(&config.seeding)?;
        let made = catch(|| entry.envs(config, entropy));
        let envs = made.map_err(|message| EnvPanic { id: entry.spec.id, env: None, seed: None, message })??;
        Ok(Pool {
            entry: Arc::clone(entry),
            layout,
            envs,
            buffers: Buffers::new(entropy.identity()),
            frame: FrameFormat::new(&entry.spec, config.frames),
            check_drawing: config.check_drawing,
            autoreset: config.autoreset,
            threads: threads.clone(),
            first_env: config.first_env,
            was_reset: false,
        })
    }

    /// Steps with these threads from now on. Results do not depend on them.
    pub fn set_threads(&mut self, threads: &Threads) {
        self.threads.clone_from(threads);
    }

    /// The specification of the environment id.
    pub fn spec(&self) -> &EnvSpec {
        &self.entry.spec
    }

    /// The layout of this pool's batches.
    pub fn layout(&self) -> &Layout {
        &self.layout
    }

    /// The threads that step the environments.
    pub fn threads(&self) -> &Threads {
        &self.threads
    }

    /// Starts episodes and writes every environment's row: the current observation, a reward of 0, and no flags.
    ///
    /// # Errors
    ///
    /// See [`reset_with`](Pool::reset_with).
    pub fn reset(&mut self, request: ResetRequest<'_>, batch: &mut [Block]) -> Result<(), PoolError> {
        self.reset_with(request, None, batch)
    }

    /// Like [`reset`](Pool::reset), with new reset parameters: the environments that start an episode play it and all later
    /// ones with `options`. Its keys are the parameters' names; omitted parameters have their defaults. `None` keeps each
    /// environment's current parameters.
    ///
    /// # Errors
    ///
    /// [`PoolError`] if `request` has the wrong length, if the first reset omits an environment, if an option
    /// is invalid, or if `batch` is too short. Except for [`PoolError::WrongFrame`] and [`PoolError::Panic`], an error changes no
    /// environment.
    pub fn reset_with(
        &mut self,
        request: ResetRequest<'_>,
        options: Option<&OptionMap>,
        batch: &mut [Block],
    ) -> Result<(), PoolError> {
        let num_envs = self.layout.num_envs();
        let request = match request {
            ResetRequest::Seed(seed) => ResetRequest::Seed(seed.wrapping_add(self.first_env as u64)),
            other => other,
        };
        match request {
            ResetRequest::Each(each) if each.len() != num_envs => {
                return Err(PoolError::ResetCount { given: each.len(), num_envs });
            }
            ResetRequest::Each(each) if !self.was_reset && each.contains(&EnvReset::Keep) => {
                return Err(PoolError::NotReset);
            }
            _ => {}
        }
        self.check_batch(batch)?;
        if let Some(options) = options {
            // Comes after all other checks, so that an error changes no environment.
            let envs = (0..num_envs).filter(|env| request.resets(*env)).collect();
            let sets = [NextOptions { options: options.clone(), envs }];
            catch(|| self.envs.set_options(&sets)).map_err(|message| self.panic(None, message))??;
        }
        self.write(batch, |envs, context, out| envs.reset(context, request, out))?;
        self.was_reset = true;
        Ok(())
    }

    /// Steps every environment once. `actions` has `num_envs` rows with one number for each branch of the action space.
    ///
    /// # Errors
    ///
    /// [`PoolError`] if the environments have not been reset, if `actions` has the wrong length or a number out of range, or if
    /// `batch` is too short. Except for [`PoolError::WrongFrame`] and [`PoolError::Panic`], an error advances
    /// no environment.
    pub fn step(&mut self, actions: &[i32], batch: &mut [Block]) -> Result<(), PoolError> {
        if !self.was_reset {
            return Err(PoolError::NotReset);
        }
        self.entry.spec.action_space.check(self.layout.num_envs(), actions)?;
        let autoreset = self.autoreset;
        self.write(batch, |envs, context, out| envs.step(context, autoreset, actions, out))
    }

    /// Rejects a batch that is too short.
    fn check_batch(&self, batch: &[Block]) -> Result<(), PoolError> {
        let (given, needed) = (batch.len(), self.layout.blocks());
        if given < needed { Err(PoolError::BatchTooShort { given, needed }) } else { Ok(()) }
    }

    /// Removes the buffer's generation stamp, calls `write` with the batch's rows, and stamps the buffer again.
    fn write(
        &mut self,
        batch: &mut [Block],
        write: impl FnOnce(&mut dyn AnyEnvs, WriteContext<'_>, BatchMut<'_>) -> Result<(), PoolError>,
    ) -> Result<(), PoolError> {
        self.check_batch(batch)?;
        let buffer = self.buffers.begin(&self.layout, batch);
        let draw = DrawSettings { current: buffer.current, frame: self.frame, check: self.check_drawing };
        let context = WriteContext { threads: &self.threads, buffer: buffer.index, draw };
        let (given, needed) = (batch.len(), self.layout.blocks());
        let out = BatchMut::new(&self.layout, batch).ok_or(PoolError::BatchTooShort { given, needed })?;
        let written = write(&mut *self.envs, context, out);
        self.was_reset &= !matches!(written, Err(PoolError::Panic(_)));
        written?;
        self.buffers.finish(buffer, &self.layout, batch);
        Ok(())
    }

    /// Sets reset parameters for the next and all later episodes of some environments, however those episodes start. Running
    /// episodes do not change. If several items name the same environment, the last one wins.
    ///
    /// # Errors
    ///
    /// [`PoolError::NoSuchEnv`], or [`PoolError::Parameters`] if an option is invalid. An error changes no environment.
    ///
    /// ```
    /// use endless_gym_core::batch::zeroed;
    /// use endless_gym_memory_gym::memory_gym;
    /// use endless_gym_core::pool::{NextOptions, Pool, PoolConfig, ResetRequest, Threads};
    ///
    /// let mut pool = Pool::new(memory_gym(), &PoolConfig::new("MortarMayhem-Grid-v0", 4), &Threads::new(1)?)?;
    /// let mut blocks = zeroed(pool.layout().blocks());
    /// let options = serde_json::from_str(r#"{"command_count": [1]}"#)?;
    /// pool.set_options(&[NextOptions { options, envs: vec![0, 3] }])?;
    /// pool.reset(ResetRequest::Seed(7), &mut blocks)?;
    /// assert_eq!(pool.running_episode(3)?.options["command_count"][0], 1);
    /// assert!(pool.running_episode(1)?.options.is_empty());
    /// assert_eq!(pool.running_episode(1)?.seed, Some(8));
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    pub fn set_options(&mut self, sets: &[NextOptions]) -> Result<(), PoolError> {
        let num_envs = self.layout.num_envs();
        if let Some(given) = sets.iter().flat_map(|set| &set.envs).find(|env| **env >= num_envs) {
            return Err(PoolError::NoSuchEnv { given: *given, num_envs });
        }
        Ok(catch(|| self.envs.set_options(sets)).map_err(|message| self.panic(None, message))??)
    }

    /// The seed and reset parameters of an environment's running episode.
    ///
    /// # Errors
    ///
    /// [`PoolError::NoSuchEnv`] or [`PoolError::NotReset`].
    pub fn running_episode(&self, env: usize) -> Result<RunningEpisode, PoolError> {
        self.check_running(env)?;
        Ok(self.envs.running_episode(env))
    }

    /// Writes every environment's row without starting an episode: the current observation, a reward of 0, and no flags.
    ///
    /// # Errors
    ///
    /// See [`reset`](Pool::reset).
    pub fn observe(&mut self, batch: &mut [Block]) -> Result<(), PoolError> {
        let num_envs = self.layout.num_envs();
        self.reset(ResetRequest::Each(&vec![EnvReset::Keep; num_envs]), batch)
    }

    /// The complete state of one environment, including its generator, for [`restore`](Pool::restore).
    ///
    /// # Errors
    ///
    /// [`SnapshotError::NoSuchEnv`] or [`SnapshotError::NotReset`].
    ///
    /// ```
    /// # use endless_gym_core::batch::{Batch, zeroed};
    /// # use endless_gym_memory_gym::memory_gym;
    /// # use endless_gym_core::pool::{Pool, PoolConfig, ResetRequest, Threads};
    /// let mut pool = Pool::new(memory_gym(), &PoolConfig::new("MysteryPath-v0", 2), &Threads::new(1)?)?;
    /// let mut blocks = zeroed(pool.layout().blocks());
    /// pool.reset(ResetRequest::Seed(3), &mut blocks)?;
    /// let snapshot = pool.snapshot(0)?;
    ///
    /// pool.step(&[1, 0, 2, 2], &mut blocks)?;
    /// let expected = Batch::new(pool.layout(), &blocks).observation()[..84 * 84 * 3].to_vec();
    ///
    /// // Environment 1 continues as environment 0 did.
    /// pool.restore(1, &snapshot)?;
    /// pool.step(&[0, 0, 1, 0], &mut blocks)?;
    /// assert_eq!(Batch::new(pool.layout(), &blocks).observation()[84 * 84 * 3..], expected);
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    pub fn snapshot(&self, env: usize) -> Result<Vec<u8>, SnapshotError> {
        self.check_env(env)?;
        if self.was_reset { self.saved(env) } else { Err(SnapshotError::NotReset) }
    }

    /// Restores an environment from a snapshot of the same id, which may come from another pool with other reset parameters.
    /// The episode continues identically. [`observe`](Pool::observe) writes its observation.
    ///
    /// The seeds of later episodes also continue from the snapshot if both pools have the same kind of
    /// [`Seeding`](super::Seeding). A stacked observation repeats the snapshot's frame, as at the start of an episode.
    ///
    /// # Errors
    ///
    /// [`SnapshotError`] if there is no such environment, if the environments have not been reset, or if `snapshot` is not a
    /// valid snapshot of this id. An error does not change the environment.
    pub fn restore(&mut self, env: usize, snapshot: &[u8]) -> Result<(), SnapshotError> {
        self.check_env(env)?;
        if self.was_reset { self.load(env, snapshot) } else { Err(SnapshotError::NotReset) }
    }

    /// The state of all environments, from which [`resume`](Pool::resume) continues identically; `None` before the first reset.
    ///
    /// # Errors
    ///
    /// [`SnapshotError::Content`] if a state cannot be encoded.
    ///
    /// ```
    /// # use endless_gym_core::batch::zeroed;
    /// # use endless_gym_memory_gym::memory_gym;
    /// # use endless_gym_core::pool::{Pool, PoolConfig, ResetRequest, Threads};
    /// let config = PoolConfig::new("MysteryPath-v0", 2);
    /// let mut pool = Pool::new(memory_gym(), &config, &Threads::new(1)?)?;
    /// let mut blocks = zeroed(pool.layout().blocks());
    /// pool.reset(ResetRequest::Seed(3), &mut blocks)?;
    /// let saved = pool.save()?.expect("the environments have been reset");
    ///
    /// let mut successor = Pool::new(memory_gym(), &config, &Threads::new(1)?)?;
    /// successor.resume(&saved)?;
    /// successor.step(&[1, 0, 2, 2], &mut blocks)?;
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    pub fn save(&self) -> Result<Option<Vec<SavedEnv>>, SnapshotError> {
        if !self.was_reset {
            return Ok(None);
        }
        let save = |env| {
            let snapshot = self.saved(env)?;
            let earlier_frames = catch(|| self.envs.earlier_frames(env, self.frame));
            Ok(SavedEnv { snapshot, earlier_frames: earlier_frames.map_err(|message| self.panic(Some(env), message))? })
        };
        (0..self.layout.num_envs()).map(save).collect::<Result<_, _>>().map(Some)
    }

    /// Continues from the state that [`save`](Pool::save) returned in a pool of the same configuration, except that its seeds
    /// may differ.
    ///
    /// # Errors
    ///
    /// [`ResumeError`] if the number of environments differs, or if a state is invalid; the environments before it have then
    /// changed.
    pub fn resume(&mut self, saved: &[SavedEnv]) -> Result<(), ResumeError> {
        let num_envs = self.layout.num_envs();
        if saved.len() != num_envs {
            return Err(ResumeError::Count { given: saved.len(), num_envs });
        }
        let frame_bytes = self.frame.bytes();
        for (env, SavedEnv { snapshot, earlier_frames }) in saved.iter().enumerate() {
            let failed = |source| ResumeError::Environment { env, source };
            self.load(env, snapshot).map_err(failed)?;
            self.envs.restore_earlier_frames(env, earlier_frames, frame_bytes).map_err(failed)?;
        }
        self.was_reset = true;
        Ok(())
    }

    fn panic(&self, env: Option<usize>, message: String) -> EnvPanic {
        let seed = env.and_then(|env| self.envs.running_episode(env).seed);
        EnvPanic { id: self.entry.spec.id, env, seed, message }
    }

    /// A snapshot of an environment whose number is in range.
    fn saved(&self, env: usize) -> Result<Vec<u8>, SnapshotError> {
        catch(|| self.envs.snapshot(env)).map_err(|message| self.panic(Some(env), message))?
    }

    /// Restores an environment whose number is in range.
    fn load(&mut self, env: usize, snapshot: &[u8]) -> Result<(), SnapshotError> {
        catch(|| self.envs.restore(env, snapshot)).map_err(|message| {
            self.was_reset = false;
            self.panic(Some(env), message)
        })?
    }

    fn check_running(&self, env: usize) -> Result<(), PoolError> {
        let num_envs = self.layout.num_envs();
        match () {
            () if env >= num_envs => Err(PoolError::NoSuchEnv { given: env, num_envs }),
            () if !self.was_reset => Err(PoolError::NotReset),
            () => Ok(()),
        }
    }

    fn check_env(&self, env: usize) -> Result<(), SnapshotError> {
        let num_envs = self.layout.num_envs();
        if env < num_envs { Ok(()) } else { Err(SnapshotError::NoSuchEnv { given: env, num_envs }) }
    }

    /// Progress of one environment's episode, for a human viewer: commands, tiles, coins, health.
    ///
    /// # Errors
    ///
    /// [`PoolError::NotReset`] or [`PoolError::NoSuchEnv`].
    pub fn progress(&self, env: usize) -> Result<Vec<Progress>, PoolError> {
        self.check_running(env)?;
        Ok(catch(|| self.envs.progress(env)).map_err(|message| self.panic(Some(env), message))?)
    }

    /// The frame that one environment's observation shows, in the default format, whether or not batches contain frames, or the
    /// [picture](EnvSpec::picture) of an environment without frames. Draws it in full and changes nothing.
    ///
    /// # Errors
    ///
    /// [`PoolError::NotReset`], [`PoolError::NoSuchEnv`] or [`PoolError::NoFrame`].
    ///
    /// ```
    /// # use endless_gym_core::batch::zeroed;
    /// # use endless_gym_memory_gym::memory_gym;
    /// # use endless_gym_core::pool::{Pool, PoolConfig, ResetRequest, Threads};
    /// let config = PoolConfig::new("MysteryPath-v0", 2).features(true).frames(None);
    /// let mut pool = Pool::new(memory_gym(), &config, &Threads::new(1)?)?;
    /// pool.reset(ResetRequest::Seed(3), &mut zeroed(pool.layout().blocks()))?;
    /// assert_eq!(pool.frame(1)?.len(), 84 * 84 * 3);
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    pub fn frame(&self, env: usize) -> Result<Vec<u8>, PoolError> {
        self.check_running(env)?;
        let format = FrameFormat::shown(self.spec()).ok_or(PoolError::NoFrame { id: self.spec().id })?;
        Ok(catch(|| self.envs.frame(env, format)).map_err(|message| self.panic(Some(env), message))?)
    }

    /// The ground-truth view of one environment, with what is hidden from the agent, at 4 times the width and height of the frame.
    ///
    /// # Errors
    ///
    /// [`PoolError::NotReset`], [`PoolError::NoSuchEnv`] or [`PoolError::NoFrame`].
    pub fn ground_truth_view(&mut self, env: usize) -> Result<Picture, PoolError> {
        self.check_running(env)?;
        let shape = self.spec().shown().ok_or(PoolError::NoFrame { id: self.spec().id })?;
        Ok(catch(|| self.envs.ground_truth_view(env, shape)).map_err(|message| self.panic(Some(env), message))?)
    }

    /// Sets the animations of an environment's ground-truth view as if [`ground_truth_view`](Self::ground_truth_view) had been
    /// called once for each earlier observation of the episode, so that the next view shows the current step. Observations are
    /// unaffected.
    ///
    /// # Errors
    ///
    /// [`PoolError::NotReset`] or [`PoolError::NoSuchEnv`].
    pub fn align_ground_truth_view(&mut self, env: usize) -> Result<(), PoolError> {
        self.check_running(env)?;
        Ok(catch(|| self.envs.align_ground_truth_view(env)).map_err(|message| self.panic(Some(env), message))?)
    }
}
