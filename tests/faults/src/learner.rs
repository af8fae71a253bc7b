//! Runs of `endless learn` that are killed and continued: each must end as an undisturbed one.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};

use serde_json::Value as Json;

use crate::actors;
use crate::cleanliness;
use crate::plan::MILLION;
use crate::scene::{LIMIT, Scene};

/// A run of a few hundredths of a second.
const RUN: &str = "MortarMayhem-Grid-v0 --environment.option command_count=[1] --environment.num-envs 4 --threads 1 \
                   --ppo.steps 8 --ppo.minibatches 2 --ppo.updates 9 --recurrence.hidden-size 8 \
                   --recurrence.sequence-length 4 --model.head-width 8 --no-stop-when-learnt";

/// The times of a run's process.
struct Times {
    /// From the start to the first checkpoint.
    start: Duration,
    /// From the start to the end.
    whole: Duration,
    is_killed: bool,
}

impl Scene<'_> {
    /// Kills a new run before or after its first checkpoint, and, at the moment `resumed`, the process that continues
    /// it.
    pub fn kill_learner(&mut self, has_checkpoint: bool, moment: u64, resumed: Option<u64>) -> Result<(), String> {
        let run = cleanliness::run(&self.namespace);
        let _ = fs::remove_dir_all(&run);
        let Some(times) = self.learn(&run, moment, |_, _| false)? else { return Ok(()) };
        let expected = files(&run)?;
        let moments = [(Some(moment), times.whole.saturating_sub(times.start)), (resumed, times.whole)];
        let (mut pace, mut is_killed) = (1.0, false);
        while !is_killed {
            fs::remove_dir_all(&run).map_err(|error| error.to_string())?;
            for (at, window) in moments.into_iter().filter_map(|(at, window)| Some((at?, window))) {
                let share = |time: Duration| time.mul_f64(pace * at as f64 / MILLION as f64);
                let must_die = |elapsed, saved: Option<Duration>| match saved {
                    Some(since) => !has_checkpoint || since >= share(window),
                    None => !has_checkpoint && elapsed >= share(times.start),
                };
                let Some(times) = self.learn(&run, moment, must_die)? else { return Ok(()) };
                is_killed = times.is_killed;
                if !is_killed {
                    // It was faster than the undisturbed process.
                    pace *= 0.8;
                    break;
                }
            }
        }
        if self.learn(&run, moment, |_, _| false)?.is_some() {
            let found = files(&run)?;
            let names = expected.keys().chain(found.keys());
            if let Some(name) = names.into_iter().find(|name| expected.get(*name) != found.get(*name)) {
                self.fail("a continued run differs", format!("{name} is not that of an undisturbed run"));
            }
        }
        fs::remove_dir_all(&run).map_err(|error| error.to_string())
    }

    /// Starts or continues a run, and kills it when `must_die` holds for the times since the start and since there is a
    /// checkpoint. A run that fails is a failure, and has no times.
    fn learn(
        &mut self,
        run: &Path,
        seed: u64,
        must_die: impl Fn(Duration, Option<Duration>) -> bool,
    ) -> Result<Option<Times>, String> {
        let mut command = Command::new(actors::engine_program()?);
        command.arg("learn");
        if run.join("settings.json").exists() {
            command.arg("--resume").arg(run);
        } else {
            let agent = ["gru", "mingru", "none"][(seed % 3) as usize];
            command.args(RUN.split_whitespace()).args(["--agent", agent, "--seed", &seed.to_string()]);
            command.args(["--checkpoint-interval", &(1 + seed % 4).to_string()]);
            command.args(seed.is_multiple_of(2).then_some("--keep-checkpoints")).arg("--run").arg(run);
        }
        let mut learner = self.spawn(command)?;
        let (began, mut saved) = (Instant::now(), None);
        loop {
            let (ended, elapsed) = (learner.ended(), began.elapsed());
            if saved.is_none() && run.join("checkpoints/last.safetensors").exists() {
                saved = Some(elapsed);
            }
            let times = |is_killed| Some(Times { start: saved.unwrap_or(elapsed), whole: elapsed, is_killed });
            match ended {
                Some(status) if status.success() => return Ok(times(false)),
                Some(status) => {
                    self.fail("a run cannot be continued", format!("{status}: {}", learner.complaint()));
                    return Ok(None);
                }
                None if must_die(elapsed, saved.map(|saved| elapsed - saved)) => {
                    learner.kill();
                    return Ok(times(true));
                }
                None if elapsed >= LIMIT => {
                    self.fail("does not end", format!("a run has not ended within {LIMIT:?}"));
                    return Ok(None);
                }
                None => self.watch(Duration::from_micros(100))?,
            }
        }
    }
}

/// The files of a run, without what depends on the time.
fn files(run: &Path) -> Result<BTreeMap<String, (Json, Vec<u8>)>, String> {
    let mut paths = Vec::new();
    cleanliness::below(run, &mut paths);
    let mut files = BTreeMap::new();
    for path in paths {
        let content = fs::read(&path).map_err(|error| format!("{}: {error}", path.display()))?;
        let name = path.strip_prefix(run).unwrap_or(&path).display().to_string();
        let json = |bytes: &[u8]| serde_json::from_slice::<Json>(bytes).unwrap_or_default();
        let content = if name.ends_with(".safetensors") {
            // The header is an object whose names have no order.
            let length = content.first_chunk().map_or(0, |length| u64::from_le_bytes(*length) as usize);
            let (header, data) = content.split_at(content.len().min(8 + length));
            (json(header.get(8..).unwrap_or_default()), data.to_vec())
        } else if name == "progress.jsonl" {
            let mut rows: Vec<_> = content.split_inclusive(|byte| *byte == b'\n').map(json).collect();
            for row in rows.iter_mut().filter_map(Json::as_object_mut) {
                row.retain(|name, _| name != "steps_per_second" && !name.starts_with("seconds/"));
            }
            (rows.into(), Vec::new())
        } else {
            (Json::Null, content)
        };
        files.insert(name, content);
    }
    // Each process writes its own.
    files.retain(|name, _| !name.starts_with("events.out.tfevents"));
    Ok(files)
}
