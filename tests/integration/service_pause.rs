//! Tests that a paused observer costs the engine nothing, keeps its slot, and gets the newest batch when it resumes.

use std::collections::HashSet;
use std::time::Instant;

use crate::support::place::Place;
use crate::support::player::Player;
use crate::support::process::TIMEOUT;
use crate::support::service::{ID, observed, reset, step};
use endless_gym::memory_gym;
use endless_gym::pool::{PoolConfig, ResetRequest};
use endless_gym::service::{Engine, EngineStatus, Observer, ServiceError, Trainer};

const NUM_ENVS: usize = 4;

/// The addresses of this many batches, none of which the trainer holds.
fn buffers(trainer: &mut Trainer, batches: usize) -> HashSet<usize> {
    (0..batches).map(|_| step(trainer, 0).blocks().as_ptr().addr()).collect()
}

#[test]
fn the_engine_writes_to_one_buffer_while_observers_are_paused() {
    let (place, _engine, mut trainer) = Place::started(NUM_ENVS, 1);
    reset(&mut trainer, 0);
    assert_eq!(buffers(&mut trainer, 20).len(), 1);
    let mut observers = [(); 2].map(|()| Observer::connect(&place.connect_config("gym"), 0).unwrap());
    assert_eq!(buffers(&mut trainer, 20).len(), 2, "the queue of an observer has the newest batch");
    for round in 0..5 {
        observers.iter_mut().for_each(Observer::pause);
        assert!(observers.iter().all(Observer::is_paused));
        // The engine notices the pause when it sends the next batch.
        step(&mut trainer, 0);
        assert_eq!(buffers(&mut trainer, 20).len(), 1, "round {round}");
        for observer in &mut observers {
            assert!(!observer.has_newer() && observer.newest().unwrap().is_none());
            assert!(!observer.is_paused());
        }
        let expected = step(&mut trainer, 0);
        for observer in &mut observers {
            let seen = observed(observer, expected.step());
            assert_eq!((seen.step(), observer.step()), (expected.step(), Some(expected.step())));
            assert_eq!(seen.batch().observation(), expected.batch().observation());
        }
    }
}

#[test]
fn a_lease_is_valid_while_its_observer_is_paused() {
    let (place, _engine, mut trainer) = Place::started(NUM_ENVS, 1);
    reset(&mut trainer, 0);
    let mut observer = Observer::connect(&place.connect_config("gym"), 0).unwrap();
    step(&mut trainer, 0);
    let lease = observer.newest().unwrap().unwrap();
    let observation = lease.batch().observation().to_vec();
    observer.pause();
    assert!(!observer.is_paused(), "the pause begins with the end of the lease");
    let newest = (0..20).map(|_| step(&mut trainer, 0).step()).last().unwrap();
    assert!(lease.batch().observation() == observation);
    assert_eq!(observed(&mut observer, newest).step(), newest);
    observer.pause();
    drop(lease);
    assert!(observer.is_paused());
    step(&mut trainer, 0);
    assert_eq!(buffers(&mut trainer, 20).len(), 1);
}

#[test]
fn a_paused_observer_keeps_its_slot() {
    let place = Place::new();
    let config = place.engine_config("gym", NUM_ENVS, 1).observers(2);
    let _engine = Engine::new(memory_gym(), &config).unwrap().spawn().unwrap();
    let connect = || Observer::connect(&place.connect_config("gym"), 0);
    let refused = |observer: Result<Observer, ServiceError>| {
        matches!(observer, Err(ServiceError::TooManyObservers { limit: 2, .. }))
    };
    let (mut first, mut second) = (connect().unwrap(), connect().unwrap());
    for paused in [1, 2] {
        first.pause();
        if paused == 2 {
            second.pause();
        }
        assert!(refused(connect()), "{paused} paused");
    }
    let status = EngineStatus::of(place.namespace(), "gym").unwrap();
    assert_eq!(status.groups[0].observers.len(), 2);
    drop(second);
    let third = connect().unwrap();
    assert!(refused(connect()));
    let mut trainer = place.trainer("gym").unwrap();
    reset(&mut trainer, 0);
    assert!(first.newest().unwrap().is_none());
    let sent = step(&mut trainer, 0).step();
    assert_eq!(observed(&mut first, sent).step(), sent);
    drop(third);
}

#[test]
fn an_idle_engine_resends_the_last_batch_to_a_resumed_observer() {
    let (place, _engine, mut trainer) = Place::started(NUM_ENVS, 1);
    let mut expected = Player::new(&PoolConfig::new(ID, NUM_ENVS));
    let connect = || Observer::connect(&place.connect_config("gym"), 0).unwrap();
    let (mut observer, mut other) = (connect(), connect());
    reset(&mut trainer, 0);
    expected.reset(ResetRequest::Seed(3));
    for round in 0..4 {
        observer.pause();
        let mut last = None;
        for _ in 0..5 {
            last = Some(step(&mut trainer, 0));
            expected.step_all(1);
        }
        let sent = last.as_ref().unwrap().step();
        assert_eq!(observed(&mut other, sent).step(), sent);
        // The engine sends the same chunk again, unless the trainer holds it.
        let held = last.filter(|_| round % 2 == 0);
        let begin = Instant::now();
        let seen = observer.next(TIMEOUT).unwrap();
        assert_eq!(seen.step(), sent, "after {:?}", begin.elapsed());
        assert!(seen.batch().observation() == expected.batch().observation());
        assert!(held.is_none_or(|held| held.batch().observation() == seen.batch().observation()));
        assert!(other.newest().unwrap().is_none(), "no observer gets a batch twice");
        drop(seen);
        assert!(observer.newest().unwrap().is_none());
    }
    // The trainer continues, whatever its queue holds.
    for _ in 0..5 {
        let last = step(&mut trainer, 0);
        expected.step_all(1);
        assert!(last.batch().observation() == expected.batch().observation());
    }
}
