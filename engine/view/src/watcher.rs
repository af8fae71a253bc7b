//! The thread that observes one engine for the browsers that show it.

use std::sync::Arc;
use std::thread;
use std::time::{Duration, Instant};

use endless_gym_core::envs::InfoColumn;
use endless_gym_service::{
    ConnectConfig, EngineStatus, ErrorKind, Observer, Pictures, ServiceError, ServiceSpecification,
};
use serde_json::{Value as Json, json};

use crate::channel::{Channel, Viewer};
use crate::engines::{self, Details};
use crate::message;
use crate::watched_group::WatchedGroup;

/// Time between two checks of what the browsers want.
const INTERVAL: Duration = Duration::from_millis(33);

/// The same while the newest batch keeps a busy engine from reusing its memory.
const URGENT_INTERVAL: Duration = Duration::from_millis(2);

/// Time between two readings of the engine's status.
const STATUS_INTERVAL: Duration = Duration::from_secs(1);

/// Time between two readings of the engine's processes and memory, which cost more than the status.
const DETAILS_INTERVAL: Duration = Duration::from_secs(5);

/// How long after the last batch the thread checks whether the engine is alive.
const LIVENESS_INTERVAL: Duration = Duration::from_millis(250);

/// Time between two attempts to connect.
const RETRY_INTERVAL: Duration = Duration::from_millis(500);

/// Observes until the last browser has left, and reconnects whenever the engine is lost.
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
        let (begin, mut is_news) = (Instant::now(), true);
        while begin.elapsed() < RETRY_INTERVAL {
            let viewers = channel.viewers();
            if viewers.is_empty() {
                return;
            }
            for viewer in viewers.iter().filter(|viewer| viewer.wants(is_news)) {
                viewer.give(|selection| message::encode(state.about(channel), None, selection, None, None));
            }
            is_news = false;
            thread::sleep(INTERVAL);
        }
    }
}

/// What the browsers are told while there is no engine.
struct State {
    name: &'static str,
    reason: String,
}

impl State {
    fn failed(&mut self, error: &ServiceError) {
        self.reason = error.to_string();
        self.name = match error.kind() {
            ErrorKind::Lost => "lost",
            // Keeps `lost` for an engine that was running before.
            ErrorKind::Unavailable => self.name,
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
    /// What the engine draws for the browsers, if its batches have no frames.
    pictures: Vec<(Arc<Viewer>, Pictures)>,
    groups: Vec<WatchedGroup>,
    status: Json,
    details: Details,
}

impl Observation {
    fn connect(channel: &Channel) -> Result<Self, ServiceError> {
        let (service, namespace) = (channel.service.clone(), channel.namespace.clone());
        let config = ConnectConfig::new(&service).namespace(namespace);
        let first = Observer::connect(&config, 0)?;
        let specification = Arc::new(first.specification().clone());
        let mut groups = vec![WatchedGroup::new(first)];
        for group in 1..specification.groups {
            let observer = Observer::connect(&config, group)?;
            if observer.specification().incarnation != specification.incarnation {
                return Err(ServiceError::EngineRestarted { service: config.service });
            }
            groups.push(WatchedGroup::new(observer));
        }
        channel.history().begin(specification.incarnation);
        Ok(Observation { specification, pictures: Vec::new(), groups, status: Json::Null, details: Details::default() })
    }

    /// Observes until the last browser has left or the engine is lost.
    fn observe(&mut self, channel: &Channel) -> Result<(), ServiceError> {
        let (mut read, mut detailed, mut heard) = (None::<Instant>, None::<Instant>, Instant::now());
        let is_due = |last: Option<Instant>, interval| last.is_none_or(|last| last.elapsed() >= interval);
        loop {
            let viewers = channel.viewers();
            if viewers.is_empty() {
                return Ok(());
            }
            let mut is_news = false;
            if is_due(read, STATUS_INTERVAL) {
                read = Some(Instant::now());
                let with_details = is_due(detailed, DETAILS_INTERVAL);
                if with_details {
                    detailed = read;
                }
                is_news = true;
                self.read_status(channel, with_details);
            }
            // A page in the background gets one batch per status, for its curves.
            let shown = |viewer: &&Arc<Viewer>| is_news || !viewer.is_hidden();
            let shown: Vec<_> = viewers.iter().filter(shown).collect();
            // Take a batch only if a browser can receive it; if no browser shows its group, only for the curves.
            let ready: Vec<_> =
                shown.iter().filter(|viewer| viewer.is_ready()).map(|viewer| viewer.selection()).collect();
            for (number, group) in self.groups.iter_mut().enumerate() {
                let is_shown = ready.iter().any(|selection| selection.group == number && !selection.envs.is_empty());
                if is_shown || (is_news && !ready.is_empty()) {
                    group.want(is_shown);
                }
            }
            for group in &mut self.groups {
                if group.take()? {
                    (is_news, heard) = (true, Instant::now());
                }
            }
            self.look(&viewers);
            if heard.elapsed() >= LIVENESS_INTERVAL {
                self.groups[0].observer().check_alive()?;
                heard = Instant::now();
            }
            self.show(channel, &shown, is_news);
            self.groups.iter_mut().for_each(WatchedGroup::release);
            let is_urgent = self.groups.iter().any(WatchedGroup::is_urgent);
            thread::sleep(if is_urgent { URGENT_INTERVAL } else { INTERVAL });
        }
    }

    /// Asks the engine to draw what the browsers show, if its batches have no frames, and reads what it has drawn.
    fn look(&mut self, viewers: &[Arc<Viewer>]) {
        let is_shown =
            |viewer: &Arc<Viewer>| !viewer.is_hidden() && viewers.iter().any(|other| Arc::ptr_eq(other, viewer));
        self.pictures.retain(|(viewer, _)| is_shown(viewer));
        for viewer in viewers.iter().filter(|viewer| !viewer.is_hidden()) {
            if self.specification.frames.is_some() || self.drawn_for(viewer).is_some() {
                continue;
            }
            match Pictures::of(self.groups[0].observer()) {
                Ok(pictures) => self.pictures.extend(pictures.map(|pictures| (Arc::clone(viewer), pictures))),
                Err(error) => tracing::debug!(%error, "the engine is not asked for pictures"),
            }
        }
        for (viewer, pictures) in &mut self.pictures {
            let selection = viewer.selection();
            if let Err(error) = pictures.want(selection.group, &selection.existing(self.specification.num_envs)) {
                tracing::debug!(%error, "the engine is not asked for other pictures");
            }
            let has_batch = self.groups.get(selection.group).is_some_and(|group| group.newest().is_some());
            if pictures.refresh() && has_batch {
                viewer.wants(true);
            }
        }
    }

    fn drawn_for(&self, viewer: &Arc<Viewer>) -> Option<&Pictures> {
        self.pictures.iter().find(|(other, _)| Arc::ptr_eq(other, viewer)).map(|(_, pictures)| pictures)
    }

    fn read_status(&mut self, channel: &Channel, with_details: bool) {
        let Some(status) = EngineStatus::of(&channel.namespace, &channel.service) else { return };
        if status.incarnation != self.specification.incarnation {
            return;
        }
        let has_success = self.specification.info.iter().any(|name| name == InfoColumn::SUCCESS);
        channel.history().point(&status, has_success);
        if with_details {
            self.details = Details::of(&status, &channel.namespace);
        }
        self.status = engines::describe(&status, &self.details);
    }

    fn show(&self, channel: &Channel, viewers: &[&Arc<Viewer>], is_news: bool) {
        for viewer in viewers.iter().filter(|viewer| viewer.wants(is_news)) {
            viewer.give(|selection| {
                let about = json!({
                    "service": channel.service,
                    "state": "live",
                    "id": self.specification.id,
                    "groups": self.specification.groups,
                    "num_envs": self.specification.num_envs,
                    "has_frames": self.specification.shown().is_some(),
                    "status": self.status,
                });
                let lease = self.groups.get(selection.group).and_then(WatchedGroup::newest);
                let drawn = self.drawn_for(viewer).and_then(Pictures::newest);
                message::encode(about, Some(&self.specification), selection, lease, drawn)
            });
        }
    }
}
