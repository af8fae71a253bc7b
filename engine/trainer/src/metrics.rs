//! What episodes amount to: their final infos, the task progress of the paper, and whether a task is learnt. As the Python agents'
//! `metrics.py` and `learnt.py`.

use endless_gym_core::batch::Batch;
use endless_gym_core::envs::{EnvSpec, ResetParameters};
use endless_gym_core::pool::OptionMap;

/// The final infos of an episode by name.
pub type Episode = Vec<(String, f64)>;

/// Fraction of the best possible result at which a task counts as learnt.
const SHARE: f64 = 0.9;

/// The final infos of an episode that ended in this step, with its task progress where the paper defines one that they determine.
pub fn final_infos(spec: &EnvSpec, options: &OptionMap, batch: &Batch<'_>, env: usize) -> Episode {
    let info = batch.info().get(env * spec.info.len()..(env + 1) * spec.info.len()).unwrap_or_default();
    let first = [("reward", batch.episode_return()[env]), ("length", batch.episode_length()[env].into())];
    let others = spec.info.iter().map(|column| column.name).zip(info.iter().copied());
    let mut episode: Episode = first.into_iter().chain(others).map(|(name, value)| (name.to_owned(), value)).collect();
    if let Some(progress) = task_progress(spec, options, &episode) {
        episode.push(("task_progress".to_owned(), progress));
    }
    episode
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

/// Task progress of an episode, 0 to 1, in Mortar Mayhem and Searing Spotlights. In Mystery Path it needs the length of the path.
fn task_progress(spec: &EnvSpec, options: &OptionMap, episode: &Episode) -> Option<f64> {
    let parameters = ResetParameters::new(spec.id, spec.parameters, options).ok()?;
    let of = |name| value(episode, name);
    if spec.id.starts_with("MortarMayhem") {
        let (share, float) = (of("commands_completed"), |name| parameters.float(name, 0.0));
        if share < 1.0 {
            return Some(share);
        }
        // The share counts a failed last command. The reward does not, unless failing has the reward of executing it.
        let (reward, bonus) = (float("reward_command_success"), float("reward_episode_success"));
        let failure = float("reward_command_failure");
        let mut counts = parameters.int_list("command_count").iter().map(|count| *count as f64).collect::<Vec<_>>();
        counts.sort_by(f64::total_cmp);
        let is_close = |a: f64, b: f64| (a - b).abs() <= 1e-6 * a.abs().max(b.abs()).max(1e-3);
        let is_return = |expected| is_close(of("reward"), expected);
        if !is_close(failure, reward + bonus) && counts.iter().any(|count| is_return(count * reward + bonus)) {
            return Some(1.0);
        }
        let count = counts.iter().find(|count| is_return((*count - 1.0) * reward + failure)).or(counts.first())?;
        return Some((count - 1.0) / count);
    }
    if spec.id.starts_with("SearingSpotlights") {
        let coins = parameters.int_list("num_coins").into_iter().max().unwrap_or(0) as f64;
        let share = if coins > 0.0 { (of("coins_collected") / coins).min(1.0) } else { 1.0 };
        return Some(if parameters.bool("use_exit", false) { (share + of("success")) / 2.0 } else { share });
    }
    None
}

/// Why a task counts as learnt, for a message, according to the means of the last episodes; `None` if it does not.
pub fn learnt(spec: &EnvSpec, options: &OptionMap, means: &Episode) -> Option<String> {
    let (mut name, mut best) = ("success", 1.0);
    if spec.id.starts_with("MortarMayhem") {
        // The infos count a failed last command as executed; the reward does not.
        let parameters = ResetParameters::new(spec.id, spec.parameters, options).ok()?;
        let counts = parameters.int_list("command_count");
        let commands = counts.iter().sum::<i64>() as f64 / counts.len() as f64;
        let bonus = parameters.float("reward_episode_success", 0.0);
        (name, best) = ("reward", commands * parameters.float("reward_command_success", 0.0) + bonus);
        if parameters.float("reward_command_failure", 0.0) > 0.0 {
            // An agent that fails may reach it, too.
            return None;
        }
    }
    let reached = means.iter().find(|(found, _)| found.strip_prefix("episode/") == Some(name))?.1;
    let is_learnt = !spec.id.starts_with("Endless") && best > 0.0 && reached >= SHARE * best;
    is_learnt
        .then(|| format!("the last episodes have a mean {name} of {reached:.3}, and at most {best:.3} is possible"))
}

#[cfg(test)]
mod tests {
    use endless_gym_core::pool::OptionMap;
    use endless_gym_memory_gym::memory_gym;

    use super::*;

    fn options(text: &str) -> OptionMap {
        serde_json::from_str(text).unwrap()
    }

    /// The cases of the Python agents' tests, which play them: `success` is 1 in all of them.
    #[test]
    fn a_failed_last_command_is_not_executed() {
        let spec = memory_gym().spec("MortarMayhem-Grid-v0").unwrap();
        for (text, reward, expected) in [
            ("{}", 0.9, 0.9),
            ("{}", 1.0, 1.0),
            (r#"{"command_count":[1]}"#, 0.0, 0.0),
            (r#"{"command_count":[2,4]}"#, 0.3, 0.75),
            (r#"{"command_count":[2],"reward_episode_success":1.0}"#, 0.1, 0.5),
            (r#"{"command_count":[2],"reward_episode_success":1.0}"#, 1.2, 1.0),
            (r#"{"command_count":[2],"reward_command_failure":-0.1}"#, 0.0, 0.5),
            (r#"{"command_count":[1],"reward_command_success":0.0,"reward_episode_success":1.0}"#, 0.0, 0.0),
            (r#"{"command_count":[2],"reward_command_failure":0.1}"#, 0.2, 0.5),
        ] {
            let episode = [("reward", reward), ("success", 1.0), ("commands_completed", 1.0)];
            let episode: Episode = episode.map(|(name, value)| (name.to_owned(), value)).into();
            let found = task_progress(spec, &options(text), &episode).unwrap();
            assert!((found - expected).abs() < 1e-12, "{text} {reward}: {found}");
        }
    }

    #[test]
    fn a_task_whose_failures_are_rewarded_is_never_learnt() {
        let spec = memory_gym().spec("MortarMayhem-Grid-v0").unwrap();
        let means = vec![("episode/reward".to_owned(), 0.1), ("episode/success".to_owned(), 1.0)];
        assert!(learnt(spec, &options(r#"{"command_count":[1]}"#), &means).is_some());
        let rewarded = r#"{"command_count":[1],"reward_command_failure":0.1}"#;
        assert!(learnt(spec, &options(rewarded), &means).is_none());
    }
}
