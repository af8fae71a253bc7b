//! Many environments in lockstep: autoreset, seeding, options, threads, and refused calls.

use crate::support::player::{Player, random_actions};
use endless_gym::batch::Frames;
use endless_gym::envs::ActionError;
use endless_gym::memory_gym;
use endless_gym::pool::{
    Autoreset, EnvReset, MAX_THREADS, Pool, PoolConfig, PoolError, ResetOptions, ResetRequest, Seeding, Threads,
};
use endless_gym_memory_gym::FRAME;
use rand::SeedableRng;
use rand::rngs::SmallRng;
use serde_json::{Map, Value as Json, json};

const ID: &str = "Endless-MortarMayhem-v0";

fn options(value: Json) -> Map<String, Json> {
    value.as_object().unwrap().clone()
}

/// Episodes are short, since an agent that does nothing fails at the first command to move.
fn config(num_envs: usize) -> PoolConfig {
    PoolConfig::new(ID, num_envs).seeding(Seeding::Continue { seed: Some(3) })
}

/// The observation of an environment.
fn frame(player: &Player, env: usize) -> Vec<u8> {
    player.batch().observation()[env * FRAME.bytes()..][..FRAME.bytes()].to_vec()
}

/// The first observation of the environment with that seed.
fn first_frame(seed: u64) -> Vec<u8> {
    let seeding = Seeding::Continue { seed: Some(seed) };
    frame(&Player::started(&PoolConfig::new(ID, 1).seeding(seeding)), 0)
}

#[test]
fn results_do_not_depend_on_the_number_of_threads() {
    for spec in memory_gym().specs() {
        let config = PoolConfig::new(spec.id, 331)
            .seeding(Seeding::Range { start: 0, end: 100_000, step: 1, seed: Some(1) })
            .features(true);
        let mut players = [1, 2, 3, 64].map(|threads| Player::in_registry(memory_gym(), &config, threads));
        players.iter_mut().for_each(|player| player.reset(ResetRequest::All));
        let mut random = SmallRng::seed_from_u64(5);
        for step in 0..80 {
            let actions = random_actions(spec, 331, &mut random);
            players.iter_mut().for_each(|player| player.step(&actions));
            let (first, others) = players.split_first().unwrap();
            for other in others {
                assert!(first.bytes() == other.bytes(), "{}, step {step}", spec.id);
            }
        }
    }
}

#[test]
fn a_group_is_a_slice_of_all_environments() {
    let whole = Player::started(&config(6));
    let half = Player::started(&config(3).first_env(3).total_envs(6));
    assert_eq!(frame(&half, 0), frame(&whole, 3));
}

#[test]
fn next_step_autoreset_starts_an_episode_in_the_step_after_its_end() {
    let (mut player, mut random) = (Player::started(&config(64)), SmallRng::seed_from_u64(5));
    let mut ended = [false; 64];
    let mut starts = 0;
    for _ in 0..200 {
        player.step_at_random(&mut random);
        let batch = player.batch();
        for (env, ended) in ended.iter_mut().enumerate() {
            if *ended {
                starts += 1;
                assert_eq!((batch.reward()[env], batch.terminated()[env]), (0.0, 0));
                assert_eq!((batch.episode_return()[env], batch.episode_length()[env]), (0.0, 0));
            }
            let longest = batch.info()[env * 2 + 1];
            assert!(longest == 0.0 || batch.terminated()[env] == 1);
            *ended = batch.terminated()[env] == 1;
        }
    }
    assert!(starts > 100, "{starts} episodes");
}

#[test]
fn same_step_autoreset_keeps_the_end_of_the_old_episode() {
    let next = config(1).autoreset(Autoreset::NextStep).features(true);
    let same = next.clone().autoreset(Autoreset::SameStep).final_observation(true);
    let (mut next, mut same) = (Player::started(&next), Player::started(&same));
    let mut ends = 0;
    for _ in 0..300 {
        next.step(&[0, 0]);
        same.step(&[0, 0]);
        assert_eq!(next.batch().reward(), same.batch().reward());
        assert_eq!(next.batch().terminated(), same.batch().terminated());
        assert_eq!(next.batch().episode_length(), same.batch().episode_length());
        assert_eq!(next.batch().info(), same.batch().info());
        if next.batch().terminated()[0] == 0 {
            assert_eq!(frame(&next, 0), frame(&same, 0));
            continue;
        }
        ends += 1;
        let kept = same.batch().final_ground_truth();
        assert_eq!(next.batch().ground_truth(), kept);
        assert_eq!(next.batch().features(), same.batch().final_features());
        assert_eq!(next.batch().observation(), same.batch().final_observation());
        next.step(&[0, 0]);
        assert_eq!(frame(&next, 0), frame(&same, 0), "the new episode's first observation");
        assert_eq!(next.batch().ground_truth(), same.batch().ground_truth());
    }
    assert!(ends > 5, "{ends} episodes");
}

#[test]
fn same_step_autoreset_keeps_the_final_vector_observation() {
    let config = PoolConfig::new("MortarMayhemB-Grid-v0", 1)
        .seeding(Seeding::Continue { seed: Some(3) })
        .autoreset(Autoreset::SameStep)
        .final_observation(true);
    let mut player = Player::started(&config);
    let commands = player.batch().vector_observation().to_vec();
    while player.batch().terminated()[0] == 0 {
        player.step(&[1]);
    }
    assert_eq!(player.batch().final_vector_observation(), commands);
    assert_ne!(player.batch().vector_observation(), commands);
}

#[test]
fn disabled_autoreset_leaves_resets_to_the_trainer() {
    let mut player = Player::started(&config(3).autoreset(Autoreset::Disabled));
    let mut random = SmallRng::seed_from_u64(5);
    for _ in 0..30 {
        player.step_at_random(&mut random);
    }
    assert_eq!(player.batch().episode_length(), [30; 3], "no environment resets");
    let before = frame(&player, 0);
    player.reset(ResetRequest::Each(&[EnvReset::Keep, EnvReset::Next, EnvReset::Seed(77)]));
    assert_eq!(player.batch().episode_length(), [30, 0, 0]);
    assert_eq!(frame(&player, 0), before);
    assert_eq!(frame(&player, 2), first_frame(77));
}

#[test]
fn episodes_are_seeded_as_configured() {
    let first_frames = |seeding: Seeding, episodes: usize| -> Vec<Vec<u8>> {
        let mut player = Player::started(&PoolConfig::new(ID, 2).seeding(seeding));
        let mut frames = vec![frame(&player, 0), frame(&player, 1)];
        for _ in 1..episodes {
            player.reset(ResetRequest::All);
            frames.extend([frame(&player, 0), frame(&player, 1)]);
        }
        frames
    };
    let seeds = |seeds: &[u64]| seeds.iter().map(|seed| first_frame(*seed)).collect::<Vec<_>>();
    assert_eq!(first_frames(Seeding::List(vec![10, 11, 12]), 3), seeds(&[10, 11, 12, 10, 11, 12]));
    assert_eq!(first_frames(Seeding::Continue { seed: Some(20) }, 1), seeds(&[20, 21]));
    assert_eq!(first_frames(Seeding::Range { start: 30, end: 31, step: 1, seed: None }, 2), seeds(&[30; 4]));
    let drawn = first_frames(Seeding::Range { start: 0, end: 100_000, step: 1, seed: Some(1) }, 20);
    assert_eq!(drawn, first_frames(Seeding::Range { start: 0, end: 100_000, step: 1, seed: Some(1) }, 20));
    assert_ne!(drawn, first_frames(Seeding::Range { start: 0, end: 100_000, step: 1, seed: Some(2) }, 20));
    assert_ne!(drawn[0], drawn[1], "environments draw independently");
}

#[test]
fn all_episodes_after_a_seeded_reset_depend_only_on_its_seed() {
    let range = |seed| Seeding::Range { start: 0, end: 100_000, step: 1, seed: Some(seed) };
    let pairs = [
        [Seeding::Continue { seed: Some(3) }, Seeding::Continue { seed: Some(4) }],
        [range(3), range(4)],
        [Seeding::List(vec![5, 6, 7]), Seeding::List(vec![5, 6, 7])],
    ];
    for pair in pairs {
        // One pool resets with a common seed, the other with a seed for each environment, after a different number of
        // episodes.
        let each = [ResetRequest::Seed(50), ResetRequest::Each(&[50, 51].map(EnvReset::Seed))];
        let shown = pair.clone().into_iter().zip(each).enumerate().map(|(before, (seeding, request))| {
            let mut player = Player::started(&config(2).seeding(seeding));
            for _ in 0..before {
                player.reset(ResetRequest::All);
            }
            player.reset(request);
            let mut frames = vec![frame(&player, 0), frame(&player, 1)];
            for _ in 0..4 {
                player.reset(ResetRequest::All);
                frames.extend([frame(&player, 0), frame(&player, 1)]);
            }
            frames
        });
        let [one, other] = shown.collect::<Vec<_>>().try_into().unwrap();
        assert!(one == other, "{pair:?}");
        let seeds = |seeds: &[u64]| seeds.iter().map(|seed| first_frame(*seed)).collect::<Vec<_>>();
        match pair[0] {
            Seeding::Continue { .. } => {
                let mut twin = Player::started(&config(2).seeding(Seeding::Continue { seed: Some(50) }));
                twin.pool.reset(ResetRequest::All, &mut twin.blocks).unwrap();
                assert!(one[2..4] == [frame(&twin, 0), frame(&twin, 1)], "the generator of the seed continues");
            }
            Seeding::Range { .. } => assert_ne!(one[2], one[3], "environments draw independently"),
            Seeding::List(_) => assert!(one == seeds(&[50, 51, 5, 6, 7, 5, 6, 7, 5, 6]), "the list starts again"),
        }
    }
}

#[test]
fn the_number_of_threads_is_limited() {
    assert!(matches!(Threads::new(MAX_THREADS + 1), Err(PoolError::ThreadCount { given }) if given == MAX_THREADS + 1));
    assert!(matches!(Threads::new(usize::MAX), Err(PoolError::ThreadCount { .. })));
}

#[test]
fn each_environment_may_have_its_own_options() {
    let each = vec![options(json!({})), options(json!({"agent_scale": 0.4})), options(json!({}))];
    let (options, seeding) = (ResetOptions::Each(each), Seeding::List(vec![8]));
    let player = Player::started(&PoolConfig::new(ID, 3).options(options).seeding(seeding));
    assert_eq!(frame(&player, 0), first_frame(8));
    assert_ne!(frame(&player, 1), first_frame(8));
    assert_eq!(frame(&player, 2), first_frame(8));
}

#[test]
fn a_reset_may_change_the_options() {
    let other = options(json!({"initial_command_count": 4, "agent_scale": 0.5}));
    let mut fresh = Player::started(&config(2).options(ResetOptions::Shared(other.clone())));
    let mut player = Player::started(&config(2));
    let before = frame(&player, 1);
    let request = ResetRequest::Each(&[EnvReset::Seed(3), EnvReset::Keep]);
    player.pool.reset_with(request, Some(&other), &mut player.blocks).unwrap();
    assert_eq!(frame(&player, 1), before, "an environment that is not reset keeps its options");
    for _ in 0..200 {
        assert_eq!(frame(&player, 0), frame(&fresh, 0));
        fresh.step(&[0, 0, 1, 1]);
        player.step(&[0, 0, 1, 1]);
    }
    let before = player.pool.snapshot(0).unwrap();
    let wrong = options(json!({"agent_scale": "large"}));
    let refused = player.pool.reset_with(ResetRequest::All, Some(&wrong), &mut player.blocks);
    assert!(matches!(refused, Err(PoolError::Parameters(_))));
    assert_eq!(player.pool.snapshot(0).unwrap(), before, "nothing has changed");
}

#[test]
fn wrong_configurations_are_refused() {
    let refused = |config: PoolConfig| {
        let error = Pool::new(memory_gym(), &config, &Threads::new(1).unwrap()).err().unwrap();
        if let Ok(spec) = memory_gym().spec(&config.id) {
            assert_eq!(config.validate(spec).unwrap_err().to_string(), error.to_string());
        }
        error
    };
    assert!(config(2).validate(memory_gym().spec(ID).unwrap()).is_ok());
    let with = |given: Json| refused(config(2).options(ResetOptions::Shared(options(given)))).to_string();
    assert!(matches!(refused(PoolConfig::new("Nothing-v0", 1)), PoolError::UnknownEnvironment(_)));
    assert_eq!(refused(config(0)).to_string(), "num_envs must be 1 to 1048576, got 0");
    for (first_env, total_envs) in [(1, 3), (usize::MAX, usize::MAX), (0, 2), (0, 1 << 32)] {
        let outside = config(3).first_env(first_env).total_envs(total_envs);
        assert!(matches!(refused(outside), PoolError::EnvNumbers { num_envs: 3, .. }));
    }
    assert!(matches!(refused(config(1).seeding(Seeding::List(vec![]))), PoolError::NoSeeds));
    for given in [0, 65] {
        let stacked = config(1).frames(Some(Frames { stack: given, ..Frames::default() }));
        assert!(matches!(refused(stacked), PoolError::Stack { given: found } if found == given));
    }
    let empty = Seeding::Range { start: 5, end: 5, step: 1, seed: None };
    assert!(matches!(refused(config(1).seeding(empty)), PoolError::SeedRange { .. }));
    let still = Seeding::Range { start: 4, end: 12, step: 0, seed: None };
    assert!(matches!(refused(config(1).seeding(still)), PoolError::SeedStep));
    let two = ResetOptions::Each(vec![Map::new(); 2]);
    assert!(matches!(refused(config(3).options(two)), PoolError::OptionsCount { .. }));
    assert!(with(json!({"arena_sise": 5})).contains("`arena_sise`; it has max_steps, agent_scale"));
    assert!(with(json!({"allowed_commands": 3})).contains("`allowed_commands` must be an integer, 4 to 9, got 3"));
    assert!(with(json!({"visual_feedback": 1})).contains("`visual_feedback` must be true or false, got 1"));
    let one_of_two = ResetOptions::Each(vec![Map::new(), options(json!({"agent_speed": "fast"}))]);
    let text = refused(config(2).options(one_of_two).first_env(4).total_envs(6)).to_string();
    assert!(text.contains("environment 5") && text.contains("agent_speed"), "{text}");
}

#[test]
fn wrong_calls_are_refused_and_change_nothing() {
    let Player { mut pool, mut blocks } = Player::new(&config(2));
    assert!(matches!(pool.step(&[0; 4], &mut blocks), Err(PoolError::NotReset)));
    pool.reset(ResetRequest::All, &mut blocks).unwrap();
    let before = blocks.clone();
    assert!(matches!(pool.step(&[0; 3], &mut blocks), Err(PoolError::Action(ActionError::Count { given: 3, .. }))));
    assert!(matches!(pool.step(&[0, 0, 0, 3], &mut blocks), Err(PoolError::Action(ActionError::Range { env: 1, .. }))));
    assert!(matches!(
        pool.step(&[-1, 0, 0, 0], &mut blocks),
        Err(PoolError::Action(ActionError::Range { env: 0, .. }))
    ));
    assert!(matches!(pool.step(&[0; 4], &mut blocks[1..]), Err(PoolError::BatchTooShort { .. })));
    let request = ResetRequest::Each(&[EnvReset::Next]);
    assert!(matches!(pool.reset(request, &mut blocks), Err(PoolError::ResetCount { .. })));
    assert!(bytemuck::cast_slice::<_, u8>(&before) == bytemuck::cast_slice::<_, u8>(&blocks));
}
