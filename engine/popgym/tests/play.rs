//! Tests of all ids in pools: experts, snapshots and threads. `tests/fuzz` forges snapshots.

use endless_gym_core::batch::{Batch, Block, zeroed};
use endless_gym_core::envs::EnvSpec;
use endless_gym_core::pool::{Autoreset, Experts, Pool, PoolConfig, ResetRequest, Seeding, Threads};
use endless_gym_core::random::Generator;
use endless_gym_popgym::popgym;

struct Player {
    pool: Pool,
    blocks: Vec<Block>,
}

impl Player {
    /// Environments whose first episodes have seeds from `seed` on.
    fn new(id: &str, num_envs: usize, threads: usize, seed: u64) -> Self {
        let seeding = Seeding::Continue { seed: Some(1) };
        let config = PoolConfig::new(id, num_envs).features(true).frames(None).seeding(seeding);
        let pool = Pool::new(popgym(), &config, &Threads::new(threads).unwrap()).unwrap();
        let blocks = zeroed(pool.layout().blocks());
        let mut player = Player { pool, blocks };
        player.pool.reset(ResetRequest::Seed(seed), &mut player.blocks).unwrap();
        player
    }

    fn step(&mut self, actions: &[i32]) {
        self.pool.step(actions, &mut self.blocks).unwrap();
    }

    fn batch(&self) -> Batch<'_> {
        Batch::new(self.pool.layout(), &self.blocks)
    }
}

fn actions(spec: &EnvSpec, num_envs: usize, random: &mut Generator) -> Vec<i32> {
    (0..num_envs).flat_map(|_| spec.action_space.sample(random)).collect()
}

#[test]
fn a_snapshot_continues_identically_and_threads_change_nothing() {
    const ENVS: usize = 64;
    for spec in popgym().specs() {
        let mut random = Generator::from_seed(3);
        let (mut one, mut two) = (Player::new(spec.id, ENVS, 1, 5), Player::new(spec.id, ENVS, 2, 5));
        for step in 0..230 {
            if step == 30 {
                // Another pool, whose environments have played other episodes.
                let mut restored = Player::new(spec.id, ENVS, 2, 900);
                (0..7).for_each(|_| restored.step(&actions(spec, ENVS, &mut random)));
                for env in 0..ENVS {
                    restored.pool.restore(env, &one.pool.snapshot(env).unwrap()).unwrap();
                }
                two = restored;
            }
            let actions = actions(spec, ENVS, &mut random);
            one.step(&actions);
            two.step(&actions);
            assert!(one.batch().bytes() == two.batch().bytes(), "{}, step {step}", spec.id);
        }
        assert!(one.batch().bytes() != Player::new(spec.id, ENVS, 1, 5).batch().bytes(), "{}", spec.id);
    }
}

#[test]
fn seeds_and_actions_determine_an_episode_whatever_was_played_before() {
    for spec in popgym().specs() {
        let (mut fresh, mut used) = (Player::new(spec.id, 4, 1, 5), Player::new(spec.id, 4, 1, 77));
        let mut random = Generator::from_seed(4);
        (0..150).for_each(|_| used.step(&actions(spec, 4, &mut random)));
        used.pool.reset(ResetRequest::Seed(5), &mut used.blocks).unwrap();
        for step in 0..300 {
            assert!(fresh.batch().bytes() == used.batch().bytes(), "{}, step {step}", spec.id);
            let actions = actions(spec, 4, &mut random);
            fresh.step(&actions);
            used.step(&actions);
        }
    }
}

/// The mean return of experts in so many episodes.
fn expert_return(id: &str, episodes: usize) -> f64 {
    let mut player = Player::new(id, episodes, 1, 0);
    let mut experts = Experts::new(popgym(), id, episodes, Autoreset::NextStep).unwrap();
    let mut actions = vec![0; episodes * popgym().spec(id).unwrap().action_space.width()];
    let (mut returns, mut played): (Vec<Option<f64>>, _) = (vec![None; episodes], 0);
    while returns.iter().any(Option::is_none) {
        experts.act(&player.batch(), &mut actions).unwrap();
        player.step(&actions);
        // No state of play is refused.
        let env = played % episodes;
        player.pool.restore(env, &player.pool.snapshot(env).unwrap()).unwrap();
        played += 1;
        let batch = player.batch();
        for (env, first) in returns.iter_mut().enumerate() {
            if batch.terminated()[env] + batch.truncated()[env] > 0 {
                first.get_or_insert(batch.episode_return()[env]);
            }
        }
    }
    returns.iter().flatten().sum::<f64>() / episodes as f64
}

#[test]
fn experts_reach_what_can_be_reached() {
    let mut ids: Vec<_> = popgym().specs().map(|spec| spec.id).collect();
    let mut played = Vec::new();
    // What the mean return of any player cannot exceed: without the first view of a board, which may be a mine; with the best arm from
    // the start; with the pendulum's velocity, by value iteration.
    let mines = [(16.0, 2.0), (36.0, 6.0), (64.0, 10.0)]
        .map(|(squares, mines): (f64, f64)| 1.0 - mines / squares * (1.5 + 1.0 / (squares - mines)));
    let arms = [10.0, 20.0, 30.0].map(|arms: f64| (arms - 1.0) / (arms + 1.0));
    let pendulum = [0.915, 0.886, 0.83];
    // More noise, not shorter episodes, makes it harder.
    let noisy_pendulum = [pendulum[0]; 3];
    // A family; for each difficulty, the least mean return, and that bound.
    for (family, least, bound) in [
        ("Autoencode", [1.0; 3], [1.0; 3]),
        ("Battleship", [0.5, 0.55, 0.55], [1.0; 3]),
        ("Concentration", [0.5, 0.5, 0.5], [1.0; 3]),
        ("CountRecall", [1.0; 3], [1.0; 3]),
        ("HigherLower", [0.5; 3], [1.0; 3]),
        ("LabyrinthEscape", [0.95, 0.9, 0.85], [1.0; 3]),
        ("LabyrinthExplore", [0.95, 0.9, 0.85], [1.0; 3]),
        ("MineSweeper", [0.7, 0.5, 0.5], mines),
        ("MultiarmedBandit", [0.7, 0.8, 0.83], arms),
        ("NoisyPositionOnlyCartPole", [0.95, 0.55, 0.33], [1.0; 3]),
        ("NoisyPositionOnlyPendulum", [0.88, 0.7, 0.6], noisy_pendulum),
        ("PositionOnlyCartPole", [1.0; 3], [1.0; 3]),
        ("PositionOnlyPendulum", [0.9, 0.865, 0.805], pendulum),
        ("RepeatFirst", [1.0; 3], [1.0; 3]),
        ("RepeatPrevious", [1.0; 3], [1.0; 3]),
        ("VelocityOnlyCartpole", [1.0; 3], [1.0; 3]),
    ] {
        for ((level, least), bound) in ["Easy", "Medium", "Hard"].into_iter().zip(least).zip(bound) {
            let id = format!("popgym-{family}{level}-v0");
            let found = expert_return(&id, 400);
            println!("{id}: {found}");
            assert!((least - 1e-9..bound + 1e-9).contains(&found), "{id}: {found}");
            played.push(id);
        }
    }
    played.sort_unstable();
    ids.sort_unstable();
    assert_eq!(played, ids);
}
