//! `endless check`.

use endless_gym_core::conformance::{Outcome, check};
use endless_gym_core::envs::UnknownEnvironment;
use endless_gym_core::pool::Registry;
use rayon::prelude::*;
use serde_json::json;

use crate::failure::Failure;
use crate::output::{print, print_json, progress};

/// Arguments of `endless check`.
#[derive(clap::Args)]
pub struct Args {
    /// Environment ids [default: all].
    ids: Vec<String>,
    /// Print JSON [default: text].
    #[arg(long)]
    json: bool,
}

/// Runs `endless check`. Returns whether every environment follows every rule.
pub fn run(registry: &Registry, args: &Args) -> Result<bool, Failure> {
    let all = || registry.specs().map(|spec| spec.id.to_owned()).collect();
    let ids: Vec<String> = if args.ids.is_empty() { all() } else { args.ids.clone() };
    ids.iter().try_for_each(|id| registry.spec(id).map(drop))?;
    // A panic of an environment is reported as its problem.
    std::panic::set_hook(Box::new(|_| {}));
    let bar = progress(ids.len() as u64, "checking {bar:40} {pos}/{len} environments");
    let checked: Result<Vec<(&String, Vec<Outcome>)>, UnknownEnvironment> = ids
        .par_iter()
        .map(|id| {
            let outcomes = check(registry, id)?;
            bar.inc(1);
            Ok((id, outcomes))
        })
        .collect();
    bar.finish_and_clear();
    drop(std::panic::take_hook());
    let checked = checked?;
    if args.json {
        let record = |(id, outcomes): &(&String, Vec<Outcome>)| {
            let rules: Vec<_> =
                outcomes.iter().map(|outcome| json!({"rule": outcome.rule, "problem": outcome.problem})).collect();
            json!({"id": id, "rules": rules})
        };
        print_json(&checked.iter().map(record).collect::<Vec<_>>())?;
    } else {
        for (id, outcomes) in &checked {
            let problems: Vec<_> =
                outcomes.iter().filter_map(|Outcome { rule, problem }| Some((rule, problem.as_ref()?))).collect();
            print(format_args!("{id}: {} of {} rules hold", outcomes.len() - problems.len(), outcomes.len()))?;
            for (rule, problem) in problems {
                print(format_args!("  not true: {rule}\n    {problem}"))?;
            }
        }
    }
    Ok(checked.iter().all(|(_, outcomes)| outcomes.iter().all(|outcome| outcome.problem.is_none())))
}
