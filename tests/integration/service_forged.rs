//! Malicious peers: forged specifications, requests and responses, and memory that changes while it is read. None may
//! make the other side panic, hang or read out of bounds.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};

use crate::support::foreign::{self, Foreign, RequestHeader};
use crate::support::place::Place;
use crate::support::recorded::property_cases;
use crate::support::service::{assert_error, play};
use endless_gym::batch::LAYOUT_VERSION;
use endless_gym::service::{Observer, ServiceError};
use proptest::prelude::*;
use proptest::test_runner::TestRunner;
use rand::rngs::SmallRng;
use rand::{RngExt, SeedableRng};

/// A number that a forger would try.
fn numbers() -> impl Strategy<Value = u64> {
    prop_oneof![
        0..9_u64,
        (0..64_u32, -1..2_i64).prop_map(|(bit, more)| (1_u64 << bit).wrapping_add_signed(more)),
        any::<u64>()
    ]
}

#[test]
fn no_specification_text_makes_a_client_panic() {
    let place = Place::new();
    let _engine = place.engine("gym", 1, 1);
    let valid = serde_json::to_vec(place.trainer("gym").unwrap().specification()).unwrap();
    let text = String::from_utf8(valid).unwrap().replace("\"service\":\"gym\"", "\"service\":\"forged\"");
    let parts = prop_oneof![
        3 => numbers().prop_map(|number| number.to_string().into_bytes()),
        1 => prop::sample::select(vec!["null", "[]", "{}", "-1", "0.5", "\"x\"", ",", ""]).prop_map(|part| part.as_bytes().to_vec()),
        1 => prop::collection::vec(any::<u8>(), 0..9),
    ];
    // Replaces a byte at any place, or the first number after it.
    let change = (any::<prop::sample::Index>(), any::<bool>(), parts);
    let mut runner = TestRunner::new(ProptestConfig { failure_persistence: None, ..property_cases(60) });
    runner
        .run(&prop::collection::vec(change, 1..4), |changes| {
            let mut text = text.clone().into_bytes();
            for (place, number, part) in changes {
                let mut start = place.index(text.len());
                let mut end = (start + 1).min(text.len());
                if number && let Some(digit) = text[start..].iter().position(u8::is_ascii_digit) {
                    start += digit;
                    end = start + text[start..].iter().take_while(|byte| byte.is_ascii_digit()).count();
                }
                text.splice(start..end, part);
            }
            let _published = foreign::specification_text(place.namespace(), "forged", &text);
            let config = place.connect_config("forged").timeout(Duration::ZERO);
            // Even a valid specification has no services.
            prop_assert!(place.trainer_now("forged").is_err());
            prop_assert!(Observer::connect(&config, 0).is_err());
            Ok(())
        })
        .unwrap();
    play(&mut place.trainer("gym").unwrap(), 0, 3);
}

#[test]
fn any_request_is_answered() {
    let place = Place::new();
    let _engine = place.engine("gym", 2, 1);
    let (foreign, good) = Foreign::of(&place);
    assert_eq!(foreign.ask(good, foreign.blocks(), |_| {}).unwrap().0, 0);
    let header = (0..11_u32, [(); 3].map(|()| numbers()), any::<bool>());
    let requests = (header, 1..=foreign.blocks(), any::<u64>(), 0..=8_u8);
    let mut runner = TestRunner::new(ProptestConfig { failure_persistence: None, ..property_cases(300) });
    runner
        .run(&requests, |((kind, [seed, env, bytes], whole), blocks, noise, density)| {
            let blocks = if whole { foreign.blocks() } else { blocks };
            let header = RequestHeader { kind, seed, env, bytes, ..good };
            let answer = foreign.ask(header, blocks, |payload| {
                let mut random = SmallRng::seed_from_u64(noise);
                let payload: &mut [u8] = bytemuck::cast_slice_mut(payload);
                let mut draws = vec![0; payload.len()];
                random.fill(payload);
                random.fill(&mut draws[..]);
                payload.iter_mut().zip(draws).for_each(|(byte, draw)| *byte *= u8::from(draw % 8 < density));
            });
            prop_assert!(answer.is_some(), "no answer");
            Ok(())
        })
        .unwrap();
    drop(foreign);
    play(&mut place.trainer("gym").unwrap(), 0, 3);
}

#[test]
fn an_engine_survives_requests_that_change_while_it_reads_them() {
    let place = Place::new();
    let _engine = place.engine("gym", 4, 1);
    let (foreign, good) = Foreign::of(&place);
    let mut random = SmallRng::seed_from_u64(1);
    for _ in 0..300 {
        let (kind, bytes) = (random.random_range(1..10), random.random_range(0..5000));
        let header = RequestHeader { kind, bytes, ..good };
        foreign
            .ask_while_changing(header, || if random.random() { random.random_range(0..8) } else { random.random() });
    }
    drop(foreign);
    play(&mut place.trainer("gym").unwrap(), 0, 3);
}

#[test]
fn an_observer_survives_batches_that_change_while_it_reads_them() {
    let (_place, mut foreign, mut observer) = foreign::observed(2);
    let done = AtomicBool::new(false);
    let (received, refused) = (AtomicU64::new(0), AtomicU64::new(0));
    std::thread::scope(|scope| {
        scope.spawn(|| {
            while !done.load(Ordering::Relaxed) {
                match observer.newest() {
                    Ok(None) => {}
                    Ok(Some(lease)) => {
                        let batch = lease.batch();
                        assert_eq!(lease.group(), 0);
                        assert_eq!(batch.reward().len(), 2);
                        std::hint::black_box(batch.observation().iter().map(|byte| u64::from(*byte)).sum::<u64>());
                        received.fetch_add(1, Ordering::Relaxed);
                    }
                    Err(ServiceError::IncompatibleTypes { .. }) => drop(refused.fetch_add(1, Ordering::Relaxed)),
                    Err(error) => panic!("{error}"),
                }
            }
        });
        let mut random = SmallRng::seed_from_u64(1);
        let start = Instant::now();
        let both = || received.load(Ordering::Relaxed) > 0 && refused.load(Ordering::Relaxed) > 0;
        for step in 0.. {
            // What the reader sees depends on the scheduler.
            if step >= 2_000 && (both() || start.elapsed() > Duration::from_secs(60)) {
                break;
            }
            let mut sent = foreign.send(step);
            for _ in 0..200 {
                let word = if random.random() { u64::from(LAYOUT_VERSION) } else { random.random() };
                sent.words.change(random.random_range(0..40), word);
                sent.payload.change(random.random_range(0..1 << 20), random.random());
            }
        }
        done.store(true, Ordering::Relaxed);
        assert!(both(), "{received:?} received, {refused:?} refused");
    });
}

#[test]
fn a_forged_payload_length_is_limited() {
    let (_place, mut foreign, mut observer) = foreign::observed(1);
    for (step, blocks) in [(5, 1 << 24), (6, 1 << 40)] {
        foreign.send(step).overwrite(0, step, blocks);
        let received = observer.newest().unwrap().unwrap();
        assert!(received.blocks().len() < 1 << 20, "{}", received.blocks().len());
        assert_eq!(received.batch().reward(), [0.0]);
    }
    foreign.send(5).overwrite(0, 5, 0);
    assert_error!(observer.newest(), ServiceError::IncompatibleTypes { .. });
}
