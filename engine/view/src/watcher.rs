//! The thread that observes one engine for the browsers that show it.

use std::sync::Arc;
use std::thread;
use std::time::{Duration, Instant};

use endless_gym_service::{BatchLease, ConnectConfig, EngineStatus, Observer, ServiceError, ServiceSpecification};
use serde_json::{Value as Json, json};

use crate::channel::{Channel, Viewer};
use crate::message;

/// Time between two looks for a batch. Episodes that end in between are not part of the means.
const POLL_INTERVAL: Duration = Duration::from_millis(4);

/// Time between two frames that a browser gets.
const FRAME_INTERVAL: Duration = Duration::from_millis(33);

/// Time between two readings of the engine's status.
const STATUS_INTERVAL: Duration = Duration::from_secs(1);

/// Without a batch for this time, the thread looks whether the engine lives.
const LIVENESS_INTERVAL: Duration = Duration::from_millis(250);

/// Time between two attempts to connect.
const RETRY_INTERVAL: Duration = Duration::from_millis(500);

/// Observes until the last browser has left, and connects again whenever the engine is lost.
pub(crate) fn run(channel: &Channel) {
    let mut state = State { name: "waiting", reason: String::new() };
    loop {
        let ended = match Observation::connect(channel) {
            Ok(mut observation) => observation.observe(channel),
            Err(error) => Err(error),
        };
        match ended {
            // Only this ends the thread: `viewers` was empty.
            Ok(()) => return,
            Err(error) => {
                tracing::debug!(%error, "the engine is not observed");
                state.failed(&error);
            }
        }
        let begin = Instant::now();
        while begin.elapsed() < RETRY_INTERVAL {
            let viewers = channel.viewers();
            if viewers.is_empty() {
                return;
            }
            let is_news = begin.elapsed() < POLL_INTERVAL;
            for viewer in viewers.iter().filter(|viewer| viewer.wants(is_news)) {
                viewer.give(|selection| message::encode(state.about(channel), None, selection, None));
            }
            thread::sleep(FRAME_INTERVAL);
        }
    }
}

/// What is said while there is no engine.
struct State {
    name: &'static str,
    reason: String,
}

impl State {
    fn failed(&mut self, error: &ServiceError) {
        self.reason = error.to_string();
        self.name = match error {
            ServiceError::EngineLost { .. }
            | ServiceError::RootRemoved { .. }
            | ServiceError::EngineRestarted { .. } => "lost",
            // An engine that was there before is not waited for, it is lost.
            ServiceError::UnknownEngine { .. } | ServiceError::EngineUnreachable { .. } => self.name,
            _ => "refused",
        };
    }

    fn about(&self, channel: &Channel) -> Json {
        json!({"service": channel.service, "state": self.name, "reason": self.reason})
    }
}

/// A connection to one run of the engine.
struct Observation {
    specification: Arc<ServiceSpecification>,
    observers: Vec<Observer>,
    /// The newest batch of each group.
    newest: Vec<Option<BatchLease>>,
    status: Json,
}

impl Observation {
    fn connect(channel: &Channel) -> Result<Self, ServiceError> {
        let (service, namespace) = (channel.service.clone(), channel.namespace.clone());
        let config = ConnectConfig { service, namespace, timeout: Duration::ZERO };
        let first = Observer::connect(&config, 0)?;
        let specification = Arc::new(first.specification().clone());
        let mut observers = vec![first];
        for group in 1..specification.groups {
            let observer = Observer::connect(&config, group)?;
            if observer.specification().incarnation != specification.incarnation {
                return Err(ServiceError::EngineRestarted { service: config.service });
            }
            observers.push(observer);
        }
        channel.history().begin(specification.incarnation);
        let newest = observers.iter().map(|_| None).collect();
        Ok(Observation { specification, observers, newest, status: Json::Null })
    }

    /// Until the last browser has left, or the engine is lost.
    fn observe(&mut self, channel: &Channel) -> Result<(), ServiceError> {
        // Where one batch may be held, it is released before the next is received, and not received more often than shown.
        let holds_one = self.specification.batches_held == 1;
        let interval = if holds_one { FRAME_INTERVAL } else { POLL_INTERVAL };
        let (mut shown, mut read, mut heard) = (None::<Instant>, None::<Instant>, Instant::now());
        let mut is_news = true;
        loop {
            let viewers = channel.viewers();
            if viewers.is_empty() {
                return Ok(());
            }
            for (observer, newest) in self.observers.iter_mut().zip(&mut self.newest) {
                if holds_one {
                    *newest = None;
                }
                if let Some(lease) = observer.newest()? {
                    channel.history().add(&lease.batch());
                    *newest = Some(lease);
                    (is_news, heard) = (true, Instant::now());
                }
            }
            if heard.elapsed() >= LIVENESS_INTERVAL {
                self.check_alive()?;
                heard = Instant::now();
            }
            if read.is_none_or(|read| read.elapsed() >= STATUS_INTERVAL) {
                read = Some(Instant::now());
                self.read_status(channel);
                is_news = true;
            }
            if shown.is_none_or(|shown| shown.elapsed() >= FRAME_INTERVAL) {
                shown = Some(Instant::now());
                self.show(channel, &viewers, is_news);
                is_news = false;
            }
            thread::sleep(interval);
        }
    }

    /// An error if the engine has ended.
    fn check_alive(&mut self) -> Result<(), ServiceError> {
        let Some(observer) = self.observers.first_mut() else { return Ok(()) };
        match observer.next(Duration::ZERO) {
            Err(ServiceError::TimedOut { .. }) => Ok(()),
            // Nothing is held of a group whose observer has no room.
            Err(ServiceError::TooManyBatchesHeld { .. }) => Ok(()),
            Err(error) => Err(error),
            Ok(lease) => {
                self.newest[0] = Some(lease);
                Ok(())
            }
        }
    }

    fn read_status(&mut self, channel: &Channel) {
        let Some(status) = EngineStatus::of(&channel.namespace, &channel.service) else { return };
        if status.incarnation != self.specification.incarnation {
            return;
        }
        channel.history().point(&status);
        self.status = crate::engines::describe(&status, &channel.namespace);
    }

    fn show(&self, channel: &Channel, viewers: &[Arc<Viewer>], is_news: bool) {
        for viewer in viewers.iter().filter(|viewer| viewer.wants(is_news)) {
            viewer.give(|selection| {
                let about = json!({
                    "service": channel.service,
                    "state": "live",
                    "id": self.specification.id,
                    "groups": self.specification.groups,
                    "num_envs": self.specification.num_envs,
                    "status": self.status,
                });
                let lease = self.newest.get(selection.group).and_then(Option::as_ref);
                message::encode(about, Some(&self.specification), selection, lease)
            });
        }
    }
}
