//! What episodes amount to: their final infos, and whether a task is learnt.

use endless_gym_core::batch::Batch;
use endless_gym_core::envs::EnvSpec;

/// The final infos of an episode by name.
pub type Episode = Vec<(String, f64)>;

/// The final infos of an episode that ended in this step.
pub fn final_infos(spec: &EnvSpec, batch: &Batch<'_>, env: usize) -> Episode {
    let info = batch.info().get(env * spec.info.len()..(env + 1) * spec.info.len()).unwrap_or_default();
    let first = [("reward", batch.episode_return()[env]), ("length", batch.episode_length()[env].into())];
    let others = spec.info.iter().map(|column| column.name).zip(info.iter().copied());
    first.into_iter().chain(others).map(|(name, value)| (name.to_owned(), value)).collect()
}

/// The number with that name; 0 if there is none.
pub fn value(episode: &Episode, name: &str) -> f64 {
    episode.iter().find(|(found, _)| found == name).map_or(0.0, |(_, value)| *value)
}

/// The mean of each final info under the name `episode/NAME`; empty without episodes.
pub fn means<'a>(episodes: impl ExactSizeIterator<Item = &'a Episode> + Clone) -> Episode {
    let count = episodes.len() as f64;
    let names = episodes.clone().next().into_iter().flatten().map(|(name, _)| name);
    names
        .map(|name| (format!("episode/{name}"), episodes.clone().map(|e| value(e, name)).sum::<f64>() / count))
        .collect()
}

/// Why a task counts as learnt, for a message, according to the means of the last episodes; `None` if it does not.
pub fn learnt(spec: &EnvSpec, means: &Episode) -> Option<String> {
    let learnt = spec.learnt?;
    let reached = means.iter().find(|(found, _)| found.strip_prefix("episode/") == Some(learnt.name))?.1;
    let (name, mean) = (learnt.name, learnt.mean);
    (reached >= mean).then(|| format!("the last episodes have a mean {name} of {reached:.3}, and {mean} is enough"))
}

#[cfg(test)]
mod tests {
    use endless_gym_memory_gym::memory_gym;

    use super::*;

    #[test]
    fn a_task_is_learnt_at_nine_tenths_of_its_best_result() {
        for (id, name, mean, is_learnt) in [
            ("MortarMayhem-Grid-v0", "task_progress", 0.91, true),
            ("MortarMayhem-Grid-v0", "task_progress", 0.89, false),
            ("MortarMayhem-Grid-v0", "success", 1.0, false),
            ("MysteryPath-v0", "success", 0.91, true),
            ("SearingSpotlights-v0", "success", 0.89, false),
            ("Endless-MortarMayhem-v0", "success", 1.0, false),
        ] {
            let means = vec![(format!("episode/{name}"), mean)];
            assert_eq!(learnt(memory_gym().spec(id).unwrap(), &means).is_some(), is_learnt, "{id} {name} {mean}");
        }
    }
}
