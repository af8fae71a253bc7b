//! An observer that is paused costs the engine nothing, keeps its place, and gets the newest batch when it resumes.

use std::collections::HashSet;
use std::time::{Duration, Instant};

use crate::support::service::{ID, Place, engine_config};
use endless_gym::batch::{Batch, zeroed};
use endless_gym::pool::{Pool, PoolConfig, ResetRequest, Threads};
use endless_gym::service::{BatchLease, EngineConfig, EngineStatus, Observer, ServiceError, Trainer};

const SECONDS: Duration = Duration::from_secs(10);
const NUM_ENVS: usize = 4;

fn step(trainer: &mut Trainer) -> BatchLease {
    trainer.send_with(0, |actions| actions.fill(1)).unwrap();
    trainer.receive(0, SECONDS).unwrap()
}

/// The addresses at which this many batches arrive, of which the trainer holds none.
fn buffers(trainer: &mut Trainer, batches: usize) -> HashSet<usize> {
    (0..batches).map(|_| step(trainer).blocks().as_ptr().addr()).collect()
}

fn reset(place: &Place) -> Trainer {
    let mut trainer = place.trainer("gym").unwrap();
    trainer.reset(0, ResetRequest::Seed(3)).unwrap();
    trainer.receive(0, SECONDS).unwrap();
    trainer
}

#[test]
fn the_engine_writes_to_one_buffer_while_observers_are_paused() {
    let place = Place::new();
    let _engine = place.engine("gym", NUM_ENVS, 1);
    let mut trainer = reset(&place);
    assert_eq!(buffers(&mut trainer, 20).len(), 1);
    let mut observers = [(); 2].map(|()| Observer::connect(&place.connect_config("gym"), 0).unwrap());
    assert_eq!(buffers(&mut trainer, 20).len(), 2, "the queue of an observer has the newest batch");
    for round in 0..5 {
        observers.iter_mut().for_each(Observer::pause);
        assert!(observers.iter().all(Observer::is_paused));
        // The engine learns of it when it sends the next batch.
        step(&mut trainer);
        assert_eq!(buffers(&mut trainer, 20).len(), 1, "round {round}");
        for observer in &mut observers {
            assert!(!observer.has_newer() && observer.newest().unwrap().is_none());
            assert!(!observer.is_paused());
        }
        let expected = step(&mut trainer);
        for observer in &mut observers {
            let seen = observer.newest().unwrap().unwrap();
            assert_eq!((seen.step(), observer.step()), (expected.step(), Some(expected.step())));
            assert_eq!(seen.batch().observation(), expected.batch().observation());
        }
    }
}

#[test]
fn a_lease_is_valid_while_its_observer_is_paused() {
    let place = Place::new();
    let _engine = place.engine("gym", NUM_ENVS, 1);
    let mut trainer = reset(&place);
    let mut observer = Observer::connect(&place.connect_config("gym"), 0).unwrap();
    step(&mut trainer);
    let lease = observer.newest().unwrap().unwrap();
    let observation = lease.batch().observation().to_vec();
    observer.pause();
    assert!(!observer.is_paused(), "the pause begins with the end of the lease");
    let newest = (0..20).map(|_| step(&mut trainer).step()).last();
    assert!(lease.batch().observation() == observation);
    assert_eq!(observer.newest().unwrap().map(|lease| lease.step()), newest);
    observer.pause();
    drop(lease);
    assert!(observer.is_paused());
    step(&mut trainer);
    assert_eq!(buffers(&mut trainer, 20).len(), 1);
}

#[test]
fn a_paused_observer_keeps_its_place() {
    let place = Place::new();
    let config = EngineConfig { observers: 2, ..engine_config(place.namespace(), "gym", NUM_ENVS, 1) };
    let mut engine = endless_gym::service::Engine::new(&config).unwrap();
    let stop = std::sync::atomic::AtomicBool::new(false);
    std::thread::scope(|scope| {
        scope.spawn(|| engine.run(&stop).unwrap());
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
        let mut trainer = reset(&place);
        assert!(first.newest().unwrap().is_none());
        let sent = step(&mut trainer).step();
        assert_eq!(first.newest().unwrap().map(|lease| lease.step()), Some(sent));
        drop(third);
        stop.store(true, std::sync::atomic::Ordering::Relaxed);
    });
}

#[test]
fn the_last_batch_is_sent_again_for_an_observer_that_resumes_while_the_trainer_pauses() {
    let place = Place::new();
    let _engine = place.engine("gym", NUM_ENVS, 1);
    let mut trainer = place.trainer("gym").unwrap();
    let mut pool = Pool::new(&PoolConfig::new(ID, NUM_ENVS), &Threads::new(1).unwrap()).unwrap();
    let mut expected = zeroed(pool.layout().blocks());
    let connect = || Observer::connect(&place.connect_config("gym"), 0).unwrap();
    let (mut observer, mut other) = (connect(), connect());
    trainer.reset(0, ResetRequest::Seed(3)).unwrap();
    pool.reset(ResetRequest::Seed(3), &mut expected).unwrap();
    trainer.receive(0, SECONDS).unwrap();
    for round in 0..4 {
        observer.pause();
        let mut last = None;
        for _ in 0..5 {
            last = Some(step(&mut trainer));
            pool.step(&[1; NUM_ENVS], &mut expected).unwrap();
        }
        let sent = last.as_ref().unwrap().step();
        assert_eq!(other.newest().unwrap().map(|lease| lease.step()), Some(sent));
        // The same chunk is sent again, unless the trainer holds it.
        let held = last.filter(|_| round % 2 == 0);
        let begin = Instant::now();
        let seen = observer.next(SECONDS).unwrap();
        assert_eq!(seen.step(), sent, "after {:?}", begin.elapsed());
        assert!(seen.batch().observation() == Batch::new(pool.layout(), &expected).observation());
        assert!(held.is_none_or(|held| held.batch().observation() == seen.batch().observation()));
        assert!(other.newest().unwrap().is_none(), "no observer gets a batch twice");
        drop(seen);
        assert!(observer.newest().unwrap().is_none());
    }
    // The trainer goes on, whatever its queue has.
    for _ in 0..5 {
        let last = step(&mut trainer);
        pool.step(&[1; NUM_ENVS], &mut expected).unwrap();
        assert!(last.batch().observation() == Batch::new(pool.layout(), &expected).observation());
    }
}
