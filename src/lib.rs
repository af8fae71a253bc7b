//! Endless Gym: environments of Memory Gym and POPGym, bit-exact and at memory speed, in this process or in shared memory
//! for any trainer on the host.
//!
//! This crate re-exports the public API of its member crates:
//!
//! - [`environments`]: the registry of all ids, those of [`memory_gym`] and [`popgym`], which are crates of their own.
//! - [`envs`]: spaces, reset parameters, scripted experts, and the trait [`Task`](envs::Task) for custom environments, which
//!   draw frames with [`raster`] and random numbers with [`random`]; [`conformance`]: checks of such environments; [`pool`]:
//!   many environments in this process; [`batch`]: what a step returns; [`trace`]: replay of recorded episodes. These are in
//!   `endless-gym-core`, which needs no operating system services and builds for WebAssembly.
//! - [`service`]: an engine, its trainer and observers, as processes that share memory. This is `endless-gym-service`.
//!
//! Each suite, `service` and `program` is a feature of that name, and all are on by default. A trainer needs only `service`, a
//! third of the dependencies:
//!
//! ```toml
//! endless-gym = { version = "0.1", default-features = false, features = ["service"] }
//! ```
//!
//! The program `endless` is `endless-gym-cli`; [`program`] runs it. Other exports of these crates (sprites and dirty
//! rectangles, the rules of single environments) exist for the project's tests and benchmarks and may change in any
//! version.

#[cfg(feature = "memory-gym")]
pub use endless_gym_memory_gym::{DEFAULT_ENV_ID, memory_gym};
#[cfg(feature = "popgym")]
pub use endless_gym_popgym::popgym;

/// The registry of the program `endless`: the ids of [`memory_gym`], then those of [`popgym`].
///
/// ```
/// assert_eq!(endless_gym::environments().specs().count(), 58);
/// ```
#[cfg(all(feature = "memory-gym", feature = "popgym"))]
pub fn environments() -> &'static pool::Registry {
    use std::sync::LazyLock;

    static REGISTRY: LazyLock<pool::Registry> =
        LazyLock::new(|| endless_gym_popgym::register(memory_gym().clone()).expect("the suites have different ids"));
    &REGISTRY
}

/// Runs the program `endless` with the environments of `registry` and the arguments of this process. In a program with
/// custom environments, it is all that `main` needs:
///
/// ```no_run
/// fn main() -> std::process::ExitCode {
///     endless_gym::program(endless_gym::memory_gym())
/// }
/// ```
#[cfg(all(feature = "program", not(target_arch = "wasm32")))]
pub fn program(registry: &pool::Registry) -> std::process::ExitCode {
    use std::io::Write;

    let arguments: Vec<_> = std::env::args_os().skip(1).collect();
    match std::env::current_exe() {
        Ok(executable) => endless_gym_cli::main(registry, arguments, &[executable.into()]).into(),
        Err(error) => {
            let _ = writeln!(std::io::stderr(), "endless: cannot find the program's own file: {error}");
            std::process::ExitCode::FAILURE
        }
    }
}

/// Arrays of a batch in memory.
pub mod batch {
    pub use endless_gym_core::batch::{
        ActionLayout, ActionSection, BLOCK_BYTES, Batch, BatchBuffer, BatchSection, Block, Dtype, Element, Frames,
        LAYOUT_VERSION, Layout, LayoutError, MAX_DIMENSIONS, MAX_STACK, RowShape, Section, SectionTable, zeroed,
    };
    pub use endless_gym_core::raster::PixelFormat;
}

/// Checks of environments, for the tests of those who write them.
pub mod conformance {
    pub use endless_gym_core::conformance::{CountingAllocator, Outcome, assert_conforms, check};
}

/// Environment ids: spaces, reset parameters, scripted experts.
pub mod envs {
    pub use endless_gym_core::envs::{
        ActionBranch, ActionError, ActionSpace, Choice, Column, EnvSpec, Expert, InfoColumn, InvalidActionSpace,
        InvalidState, Learnt, Metric, ObservationSpace, OriginalTypes, Parameter, ParameterError, ParameterKind,
        Progress, ResetParameters, RewardType, StatePart, StateSpace, Task, Transition, UnknownEnvironment, box_action,
        view,
    };
}

/// Many environments in this process, stepped in lockstep.
pub mod pool {
    pub use endless_gym_core::pool::{
        Autoreset, EnvReset, Experts, ExpertsError, MAX_ENVS, MAX_THREADS, NextOptions, OptionMap, Pool, PoolConfig,
        PoolError, Registry, RegistryError, ResetOptions, ResetRequest, ResumeError, RunningEpisode, SNAPSHOT_VERSION,
        SavedEnv, Seeding, SnapshotError, StepTimes, Threads, UnknownAutoreset, WrongFrame,
    };
    pub use endless_gym_core::random::EntropyError;
}

/// numpy's random numbers, bit for bit, for custom environments.
pub mod random {
    pub use endless_gym_core::random::Generator;
}

/// A rasteriser that paints exactly the same pixels as pygame 2.4, for custom environments.
pub mod raster {
    pub use endless_gym_core::raster::{Canvas, CornerRadii, FrameShape, Rect, Rgb, Surface};
}

/// Engines that serve environments in shared memory, their trainers and observers.
#[cfg(all(feature = "service", not(target_arch = "wasm32")))]
pub mod service {
    pub use endless_gym_service::{
        BatchLease, CHECKPOINT_VERSION, CheckpointConfig, CheckpointError, ConnectConfig, Drawn, Engine,
        EngineActivity, EngineConfig, EngineHandle, EngineProcesses, EngineStatus, EngineStopper, EngineSummary,
        ErrorKind, GroupReconnection, GroupStatus, LastRequest, LockHolder, MAX_BATCHES_HELD, MAX_GROUPS, Namespace,
        Observed, Observer, ObserverStatus, Observers, Pictures, ROOT_VARIABLE, Reconnection, Rejection, ServiceError,
        ServiceSpecification, Trainer, TrainerGroup, running_engines, timeout_from_seconds,
    };
}

/// Recorded episodes of the original, their replay, and recordings of this engine.
pub mod trace {
    pub use endless_gym_core::trace::{Difference, Episode, Recorder, Replay, Step, Trace, TraceError, replay};
}
