//! Observers of several groups of one engine, as one stream of batches.

use std::time::{Duration, Instant};

use crate::connect::ConnectConfig;
use crate::error::ServiceError;
use crate::lease::BatchLease;
use crate::observer::Observer;
use crate::specification::ServiceSpecification;

/// How long one group is waited for before the others are looked at again.
const TURN: Duration = Duration::from_millis(5);

/// Reads the batches of all groups of an engine, or of one of them, while a trainer steps it, and counts the batches that it missed.
///
/// ```no_run
/// use std::time::Duration;
///
/// use endless_gym_service::{ConnectConfig, Observers};
///
/// let mut observers = Observers::connect(&ConnectConfig::new("endless"), None)?;
/// loop {
///     let observed = observers.next(Duration::from_secs(10))?;
///     println!("group {} step {}, {} missed", observed.lease.group(), observed.lease.step(), observed.missed);
/// }
/// # #[allow(unreachable_code)]
/// # Ok::<(), endless_gym_service::ServiceError>(())
/// ```
pub struct Observers {
    observers: Vec<Observer>,
    /// The step of the last batch of each observer.
    steps: Vec<Option<u64>>,
    /// The observer that is looked at first, so that a fast group does not hide the others.
    turn: usize,
}

/// A batch that was observed.
#[derive(Debug)]
pub struct Observed {
    /// The batch.
    pub lease: BatchLease,
    /// Batches of its group between the one that was observed before and this one; 0 for the first.
    pub missed: u64,
}

impl Observers {
    /// Connects to one group of an engine, or to all for `None`. `config.timeout` applies to each group.
    ///
    /// # Errors
    ///
    /// As [`Observer::connect`].
    pub fn connect(config: &ConnectConfig, group: Option<usize>) -> Result<Self, ServiceError> {
        let mut observers = vec![Observer::connect(config, group.unwrap_or(0))?];
        if group.is_none() {
            for group in 1..observers[0].specification().groups {
                let observer = Observer::connect(config, group)?;
                if observer.specification().incarnation != observers[0].specification().incarnation {
                    return Err(ServiceError::EngineRestarted { service: config.service.clone() });
                }
                observers.push(observer);
            }
        }
        Ok(Observers { steps: vec![None; observers.len()], observers, turn: 0 })
    }

    /// The engine's specification.
    pub fn specification(&self) -> &ServiceSpecification {
        self.observers[0].specification()
    }

    /// The next batch of any of the groups. Waits for it up to `timeout`.
    ///
    /// # Errors
    ///
    /// As [`Observer::next`].
    pub fn next(&mut self, timeout: Duration) -> Result<Observed, ServiceError> {
        let (start, count) = (Instant::now(), self.observers.len());
        loop {
            for place in (0..count).map(|i| (self.turn + i) % count) {
                if let Some(lease) = self.observers[place].newest()? {
                    return Ok(self.observed(place, lease));
                }
            }
            let left = timeout.saturating_sub(start.elapsed());
            let (place, is_last) = (self.turn, count == 1 || left <= TURN);
            match self.observers[place].next(if is_last { left } else { TURN }) {
                Ok(lease) => return Ok(self.observed(place, lease)),
                Err(ServiceError::TimedOut { .. }) if !is_last => self.turn = (place + 1) % count,
                Err(ServiceError::TimedOut { service, activity, .. }) => {
                    return Err(ServiceError::TimedOut { service, waited: timeout, activity });
                }
                Err(error) => return Err(error),
            }
        }
    }

    fn observed(&mut self, place: usize, lease: BatchLease) -> Observed {
        self.turn = (place + 1) % self.observers.len();
        let before = self.steps[place].replace(lease.step());
        let missed = before.map_or(0, |before| lease.step().saturating_sub(before.saturating_add(1)));
        Observed { lease, missed }
    }
}
