//! Groups of an engine that step at the same time, and trainers that use a thread for each.

use endless_gym::memory_gym;
use endless_gym::pool::{PoolConfig, ResetRequest};
use endless_gym::service::{BatchLease, CheckpointConfig, Engine, EngineConfig, ServiceError, Trainer, TrainerGroup};

use crate::support::place::Place;
use crate::support::player::Player;
use crate::support::process::{Process, TIMEOUT};
use crate::support::service::{ID, assert_error};

const NUM_ENVS: usize = 8;
const GROUPS: usize = 8;

impl Place {
    /// Starts an engine whose environments meet, and connects to it.
    fn meeting(&self, num_envs: usize, groups: usize, threads: usize) -> (Process, Trainer) {
        let engine = self.role(&format!("meeting {num_envs} {groups} {threads}"));
        let mut trainer = self.trainer("meeting").unwrap();
        for group in trainer.groups() {
            group.reset(ResetRequest::All).unwrap();
            group.receive(TIMEOUT).unwrap();
        }
        (engine, trainer)
    }
}

/// Steps a group of which one environment takes part in a meeting of that many.
fn send(group: &mut TrainerGroup, meeting: i32) {
    group
        .send_with(|actions| {
            actions.fill(0);
            actions[0] = meeting;
        })
        .unwrap();
}

#[track_caller]
fn assert_met(batch: &BatchLease) {
    assert_eq!(batch.batch().reward()[0], 1.0, "group {} steps alone", batch.group());
}

#[test]
fn groups_with_requests_step_at_the_same_time() {
    let place = Place::new();
    let (engine, mut trainer) = place.meeting(NUM_ENVS, GROUPS, GROUPS);
    for round in 0..20 {
        trainer.groups().iter_mut().for_each(|group| send(group, GROUPS as i32));
        for number in 0..GROUPS {
            let batch = if round % 2 == 0 { trainer.receive(number, TIMEOUT) } else { trainer.receive_any(TIMEOUT) };
            assert_met(&batch.unwrap());
        }
    }
    engine.end();
}

/// There are two threads, each with its own groups, and it must not matter which of the groups have requests.
#[test]
fn a_free_thread_steps_the_groups_of_a_busy_one() {
    let place = Place::new();
    let (engine, mut trainer) = place.meeting(NUM_ENVS, GROUPS, 2);
    for round in 0..3 {
        for first in 0..GROUPS {
            for second in (0..GROUPS).filter(|second| *second != first) {
                send(&mut trainer.groups()[first], 2);
                if round == 2 && first == 0 {
                    // Until all threads are parked, except one that waits for the other group.
                    std::thread::sleep(std::time::Duration::from_millis(10));
                }
                send(&mut trainer.groups()[second], 2);
                for _ in 0..2 {
                    assert_met(&trainer.receive_any(TIMEOUT).unwrap());
                }
            }
        }
    }
    engine.end();
}

#[test]
fn more_groups_than_threads_are_all_served() {
    let place = Place::new();
    let (engine, mut trainer) = place.meeting(1, GROUPS, 3);
    std::thread::scope(|scope| {
        for group in trainer.groups() {
            scope.spawn(move || {
                for step in 2..500 {
                    send(group, 0);
                    assert_eq!(group.receive(TIMEOUT).unwrap().step(), step);
                }
            });
        }
    });
    engine.end();
}

/// Each thread receives only when the others have sent.
#[test]
fn a_trainer_steps_each_group_in_a_thread() {
    let place = Place::new();
    let (engine, trainer) = place.meeting(NUM_ENVS, GROUPS, GROUPS);
    let threads: Vec<_> = trainer
        .into_groups()
        .into_iter()
        .map(|mut group| {
            std::thread::spawn(move || {
                for round in 0..50 {
                    if round == 25 && group.number() == 3 {
                        // The others park.
                        std::thread::sleep(std::time::Duration::from_millis(20));
                    }
                    send(&mut group, GROUPS as i32);
                    assert_met(&group.receive(TIMEOUT).unwrap());
                    assert_error!(group.receive(TIMEOUT), ServiceError::NothingSent { .. });
                }
                group
            })
        })
        .collect();
    let mut groups: Vec<_> = threads.into_iter().map(|thread| thread.join().unwrap()).collect();
    groups.reverse();
    let last = groups.pop().unwrap();
    let error = Trainer::from_groups(&mut groups).map(drop).unwrap_err();
    assert!(error.to_string().contains("one trainer"), "{error}");
    groups.push(last);
    let mut trainer = Trainer::from_groups(&mut groups).unwrap();
    assert!(!trainer.reconnect(TIMEOUT).unwrap().restarted);
    assert_error!(trainer.group(GROUPS), ServiceError::NoSuchGroup { given: GROUPS, .. });
    engine.end();
}

#[test]
fn groups_of_two_trainers_are_an_error_and_sorted_groups_keep_their_numbers() {
    let place = Place::new();
    let start = |service, groups| {
        let engine = Engine::new(memory_gym(), &place.engine_config(service, 1, groups)).unwrap().spawn().unwrap();
        (engine, place.trainer(service).unwrap())
    };
    let ((_first, mut many), (second, mut one)) = (start("many", 2), start("one", 1));
    many.reset(1, ResetRequest::All).unwrap();
    many.receive(1, TIMEOUT).unwrap();
    many.groups().reverse();
    let steps: Vec<_> = many.reconnect(TIMEOUT).unwrap().groups.iter().map(|group| group.step).collect();
    assert_eq!(steps, [Some(0), Some(1)]);

    std::mem::swap(&mut many.groups()[1], &mut one.groups()[0]);
    drop(second);
    assert_error!(one.reconnect(TIMEOUT), ServiceError::MixedGroups);
    assert_error!(many.reconnect(TIMEOUT), ServiceError::MixedGroups);
    assert_error!(many.receive_any(TIMEOUT), ServiceError::MixedGroups);
    std::mem::swap(&mut many.groups()[1], &mut one.groups()[0]);
    let _third = Engine::new(memory_gym(), &place.engine_config("one", 1, 1)).unwrap().spawn().unwrap();
    assert!(one.reconnect(TIMEOUT).unwrap().restarted);
    assert!(!many.reconnect(TIMEOUT).unwrap().restarted);
}

/// Threads reset, step and save at the same time, and every group plays what it would play alone.
#[test]
fn groups_that_step_at_the_same_time_play_the_same_bytes() {
    const STEPS: usize = 150;
    let place = Place::new();
    let file = place.root().join("checkpoint");
    let pool = PoolConfig::new(ID, NUM_ENVS).check_drawing(true);
    let every = Some(std::time::Duration::from_millis(5));
    let checkpoint = Some(CheckpointConfig::new(&file).every(every));
    let namespace = place.namespace().clone();
    let config = EngineConfig::new("gym", pool, 4).namespace(namespace).groups(4).checkpoint(checkpoint);
    let mut twins = Player::new(&PoolConfig::new(ID, 4 * NUM_ENVS));
    let engine = Engine::new(memory_gym(), &config).unwrap().spawn().unwrap();
    let saved: Vec<Vec<u64>> = std::thread::scope(|scope| {
        let trainer = place.trainer("gym").unwrap();
        let played = trainer.into_groups().into_iter().map(|mut group| {
            scope.spawn(move || {
                let (mut frames, mut saved) = (Vec::new(), Vec::new());
                for step in 0..STEPS {
                    if step == 0 {
                        group.reset(ResetRequest::Seed(7)).unwrap();
                    } else {
                        group.send_with(|actions| actions.fill((step % 4) as i32)).unwrap();
                    }
                    let lease = group.receive(TIMEOUT).unwrap();
                    frames.push(lease.batch().observation().to_vec());
                    if step % 25 == 24 {
                        saved.push(group.checkpoint(TIMEOUT).unwrap());
                        assert_eq!(saved.last().unwrap()[group.number()], step as u64 + 1);
                    }
                }
                (frames, saved)
            })
        });
        let threads: Vec<_> = played.collect();
        let played: Vec<_> = threads.into_iter().map(|thread| thread.join().unwrap()).collect();
        for step in 0..STEPS {
            if step == 0 {
                twins.reset(ResetRequest::Seed(7));
            } else {
                twins.step_all((step % 4) as i32);
            }
            let frames: Vec<u8> = played.iter().flat_map(|(frames, _)| frames[step].clone()).collect();
            assert!(frames == twins.batch().observation(), "step {step}");
        }
        played.into_iter().flat_map(|(_, saved)| saved).collect()
    });
    engine.stop();
    assert_eq!(engine.join().unwrap().batches, 4 * STEPS as u64);
    assert!(saved.iter().all(|steps| steps.len() == 4));
    assert!(file.exists());
}
