//! `endless verify`.

use std::path::PathBuf;

use endless_gym_core::pool::Registry;
use endless_gym_core::printable;
use endless_gym_core::trace::{Trace, replay};
use rayon::prelude::*;
use serde_json::json;

use crate::failure::Failure;
use crate::output::{print, print_json, progress};

/// Arguments of `endless verify`.
#[derive(clap::Args)]
pub struct Args {
    /// Trace files, gzip-compressed JSON (`.json.gz`).
    #[arg(required = true)]
    files: Vec<PathBuf>,
    /// Print JSON [default: text].
    #[arg(long)]
    json: bool,
}

/// Runs `endless verify`. Returns whether every trace was replayed without a difference.
pub fn run(registry: &Registry, args: &Args) -> Result<bool, Failure> {
    let bar = progress(args.files.len() as u64, "replaying {bar:40} {pos}/{len} traces");
    let replays: Vec<_> = args
        .files
        .par_iter()
        .map(|file| {
            let replayed = Trace::open(file).and_then(|trace| replay(registry, &trace));
            bar.inc(1);
            (file, replayed)
        })
        .collect();
    bar.finish_and_clear();

    let (mut episodes, mut steps, mut differences, mut failures) = (0, 0, 0, 0);
    let mut records = Vec::new();
    for (file, replayed) in &replays {
        let name = file.display();
        let text = match replayed {
            Ok(replay) => {
                episodes += replay.episodes;
                steps += replay.steps;
                differences += replay.differences;
                let verdict = replay.first.as_ref().map_or("no difference".to_owned(), |first| {
                    format!("{} differences, the first in {first}", replay.differences)
                });
                let views = match replay.views {
                    0 => String::new(),
                    views => format!(", {views} ground-truth views"),
                };
                format!("{} episodes, {} steps{views}, {verdict}", replay.episodes, replay.steps)
            }
            Err(error) => {
                failures += 1;
                format!("not replayed: {error}")
            }
        };
        if args.json {
            records.push(json!({
                "file": file,
                "episodes": replayed.as_ref().ok().map(|replay| replay.episodes),
                "steps": replayed.as_ref().ok().map(|replay| replay.steps),
                "differences": replayed.as_ref().ok().map(|replay| replay.differences),
                "verdict": text,
            }));
        } else {
            print(printable(format_args!("{name}: {text}")))?;
        }
    }
    if args.json {
        print_json(&json!({
            "traces": records,
            "episodes": episodes,
            "steps": steps,
            "differences": differences,
            "not_replayed": failures,
        }))?;
    } else {
        if failures > 0 {
            print(format_args!("{failures} traces not replayed"))?;
        }
        let verified = replays.len() - failures;
        print(format_args!(
            "verified {verified} traces: {episodes} episodes, {steps} steps, {differences} differences"
        ))?;
    }
    Ok(differences + failures == 0)
}
