//! Requests about episodes: the options of the next ones, and what the running ones follow from.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::Duration;

use endless_gym_core::batch::{ActionSection, Block, OPTIONS_BYTES, SNAPSHOT_BYTES};
use endless_gym_core::pool::{NextOptions, PoolError, RunningEpisode};
use serde_json::Value as Json;

use super::Trainer;
use crate::error::ServiceError;
use crate::message::RequestKind;
use crate::pending::Request;

/// Most environments in one item of a message: with options of [`OPTIONS_BYTES`] their numbers fit a message.
const ENVS_PER_ITEM: usize = 16_384;

impl Trainer {
    /// Sets the reset parameters of environments' next episodes and all later ones; see
    /// [`Pool::set_options`](endless_gym_core::pool::Pool::set_options). It may precede the first reset.
    ///
    /// After [`ServiceError::TimedOut`], the same call may be repeated; the engine may still set the options, but not after a
    /// later request.
    ///
    /// # Errors
    ///
    /// [`ServiceError::OptionsTooLong`], [`ServiceError::AnswerPending`] if the group has a pending batch,
    /// [`ServiceError::Rejected`] if there is no such environment or an option is not valid, and the errors of
    /// [`receive`](Trainer::receive). A rejected call changes no environment, unless its JSON text is longer than
    /// [`SNAPSHOT_BYTES`] and so takes several messages.
    ///
    /// ```no_run
    /// # use std::time::Duration;
    /// # use endless_gym_core::pool::NextOptions;
    /// # use endless_gym_service::{ConnectConfig, Trainer};
    /// # let timeout = Duration::from_secs(10);
    /// # let mut trainer = Trainer::connect(&ConnectConfig::new("endless"))?;
    /// let options = serde_json::from_str(r#"{"command_count": [2]}"#)?;
    /// trainer.set_options(0, &[NextOptions { options, envs: vec![3, 5] }], timeout)?;
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    pub fn set_options(&mut self, group: usize, sets: &[NextOptions], timeout: Duration) -> Result<(), ServiceError> {
        for text in messages(sets)? {
            let specification = Arc::clone(&self.specification);
            let write = |message: &mut [Block]| {
                let place = specification.action.write::<u8>(message, ActionSection::Snapshot);
                place[..text.len()].copy_from_slice(&text);
                Ok(text.len())
            };
            let request = Request { checksum: crc32fast::hash(&text), ..Request::new(RequestKind::SetOptions) };
            self.transfer(group, request, timeout, write)?;
        }
        Ok(())
    }

    /// What the running episodes of environments follow from, in the order of their numbers. This trainer must have reset the
    /// group before.
    ///
    /// # Errors
    ///
    /// [`ServiceError::Pool`] if an environment's number is out of range, [`ServiceError::AnswerPending`] if the group has a
    /// pending batch, [`ServiceError::Rejected`] if the group was not reset, and the errors of [`receive`](Trainer::receive).
    pub fn running_episodes(
        &mut self,
        group: usize,
        envs: &[usize],
        timeout: Duration,
    ) -> Result<Vec<RunningEpisode>, ServiceError> {
        let num_envs = self.specification.num_envs;
        let mut missing: BTreeSet<usize> = envs.iter().copied().collect();
        if let Some(given) = missing.last().copied().filter(|env| *env >= num_envs) {
            return Err(PoolError::NoSuchEnv { given, num_envs }.into());
        }
        let mut episodes = Vec::new();
        while !missing.is_empty() {
            let mask: Vec<u8> = (0..num_envs).map(|env| u8::from(missing.contains(&env))).collect();
            let specification = Arc::clone(&self.specification);
            let write = |message: &mut [Block]| {
                specification.action.write::<u8>(message, ActionSection::Reset).copy_from_slice(&mask);
                Ok(0)
            };
            let request = Request { checksum: crc32fast::hash(&mask), ..Request::new(RequestKind::Episodes) };
            let text = self.transfer(group, request, timeout, write)?;
            // As many as fit a response, at least one.
            let received: Vec<RunningEpisode> = serde_json::from_slice(&text).map_err(|_| self.incompatible())?;
            let before = missing.len();
            for episode in &received {
                missing.remove(&episode.env);
            }
            if missing.len() == before {
                return Err(self.incompatible());
            }
            episodes.extend(received);
        }
        Ok(episodes)
    }
}

/// The items as JSON lists, each of which fits a message.
fn messages(sets: &[NextOptions]) -> Result<Vec<Vec<u8>>, ServiceError> {
    let mut messages: Vec<Vec<u8>> = Vec::new();
    for set in sets {
        let options = Json::from(set.options.clone()).to_string();
        if options.len() > OPTIONS_BYTES {
            return Err(ServiceError::OptionsTooLong { given: options.len() });
        }
        for envs in set.envs.chunks(ENVS_PER_ITEM) {
            let item = format!(r#"{{"options":{options},"envs":{}}}"#, Json::from(envs)).into_bytes();
            match messages.last_mut() {
                Some(message) if message.len() + item.len() + 2 <= SNAPSHOT_BYTES => message.push(b','),
                _ => messages.push(vec![b'[']),
            }
            messages.iter_mut().last().into_iter().for_each(|message| message.extend_from_slice(&item));
        }
    }
    messages.iter_mut().for_each(|message| message.push(b']'));
    Ok(messages)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn long_lists_are_divided_among_messages() {
        let options =
            |count: usize| [("command_show_delay".to_owned(), Json::from(vec![1; count]))].into_iter().collect();
        let sets = [
            NextOptions { options: options(8_000), envs: (1_000_000..1_040_000).collect() },
            NextOptions { options: options(2), envs: vec![7] },
            NextOptions { options: options(3), envs: Vec::new() },
        ];
        let messages = messages(&sets).unwrap();
        assert_eq!(messages.len(), 2);
        assert!(messages.iter().all(|message| message.len() <= SNAPSHOT_BYTES));
        let items: Vec<NextOptions> =
            messages.iter().flat_map(|text| serde_json::from_slice::<Vec<NextOptions>>(text).unwrap()).collect();
        let envs: Vec<usize> = items.iter().flat_map(|item| item.envs.clone()).collect();
        assert!(envs == (1_000_000..1_040_000).chain([7]).collect::<Vec<_>>());
        assert!(items[..items.len() - 1].iter().all(|item| item.options == sets[0].options));
        assert_eq!(items.last(), Some(&sets[1]));
        let long = [NextOptions { options: options(9_000), envs: vec![0] }];
        assert!(matches!(super::messages(&long), Err(ServiceError::OptionsTooLong { .. })));
    }
}
