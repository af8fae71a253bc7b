//! Plays one round: start, faults, end, and the search for leftovers.

use std::time::Duration;

use endless_gym_service::Namespace;

use crate::actors::Actor;
use crate::cleanliness;
use crate::event::now;
use crate::plan::{Plan, Role};
use crate::report::Outcome;
use crate::rights::Rights;
use crate::scene::{LIMIT, Scene};

/// Visits of a visitor that stays for the whole round.
const ALWAYS: usize = 1_000_000;

/// Plays a round in the namespace of the environment.
pub fn play(plan: &Plan, rights: Rights) -> Result<Outcome, String> {
    let mut scene = Scene::new(plan, Namespace::default());
    scene.start(Role::Engine)?;
    scene.start(Role::Trainer)?;
    if plan.observers > 0 {
        scene.start(Role::Observer)?;
    }
    for _ in 0..plan.visitors {
        scene.visitor(ALWAYS)?;
    }
    if recover(&mut scene, now())?.is_some() || rescue(&mut scene)? {
        faults(&mut scene, rights)?;
    }
    scene.current = None;
    end(&mut scene)?;
    Ok(std::mem::take(&mut scene.outcome))
}

fn faults(scene: &mut Scene<'_>, rights: Rights) -> Result<(), String> {
    for step in &scene.plan.steps {
        if !rights.permit(step.fault) {
            *scene.outcome.left_out.entry(step.fault.kind()).or_default() += 1;
            continue;
        }
        scene.watch(Duration::from_millis(step.pause))?;
        scene.current = Some(step.fault);
        let over = scene.apply(step.fault)?;
        let recovered = recover(scene, over)?;
        scene.outcome.faults.push((step.fault.kind(), recovered.map(|time| time.as_secs_f64() * 1e3)));
        if recovered.is_none() && !rescue(scene)? {
            break;
        }
        scene.others.retain_mut(|other| other.ended().is_none());
    }
    Ok(())
}

/// The time from `since` to the next correct batch. Its absence is recorded as a failure.
fn recover(scene: &mut Scene<'_>, since: Duration) -> Result<Option<Duration>, String> {
    let next = scene.next_batch(since, LIMIT)?;
    if next.is_none() {
        let last = |kind: &str| scene.last_errors.get(kind).map_or("", String::as_str);
        let errors = scene.outcome.errors.iter();
        let errors: Vec<_> =
            errors.map(|(kind, count)| format!("{kind} {count}, the last of them: {}", last(kind))).collect();
        scene.fail(
            "no recovery",
            format!("no correct batch within {LIMIT:?}; errors of the round: {}", errors.join(", ")),
        );
    }
    Ok(next.map(|at| at.saturating_sub(since)))
}

/// Replaces all processes, as a supervisor would. Returns whether that helps.
fn rescue(scene: &mut Scene<'_>) -> Result<bool, String> {
    scene.others.clear();
    for role in [Role::Observer, Role::Trainer, Role::Engine] {
        scene.kill(role);
    }
    scene.start(Role::Engine)?;
    scene.start(Role::Trainer)?;
    let next = scene.next_batch(now(), LIMIT)?;
    if next.is_none() {
        scene.fail(
            "only a person can recover",
            format!("no correct batch within {LIMIT:?} after all processes were replaced"),
        );
    }
    Ok(next.is_some())
}

/// Ends all processes regularly, and finds what they leave behind.
pub fn end(scene: &mut Scene<'_>) -> Result<(), String> {
    for other in &mut scene.others {
        other.close_input();
    }
    let mut others = std::mem::take(&mut scene.others);
    for mut other in others.drain(..) {
        if other.wait(LIMIT).is_none() {
            scene.fail("does not end", "a visitor or observer was asked to end".to_owned());
        }
    }
    for role in [Role::Trainer, Role::Observer, Role::Engine] {
        scene.end(role, Actor::close_input)?;
    }
    scene.close();
    for left in cleanliness::leftovers(&scene.namespace) {
        scene.fail("left behind", left);
    }
    Ok(())
}
