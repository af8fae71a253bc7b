//! Tests of the experts of all ids. The checks of `conformance` and `tests/fuzz` play all ids, too.

use endless_gym_core::batch::{Batch, zeroed};
use endless_gym_core::conformance;
use endless_gym_core::pool::{Autoreset, Experts, Pool, PoolConfig, ResetRequest, Threads};
use endless_gym_popgym::popgym;

/// The mean return of experts in so many episodes.
fn expert_return(id: &str, episodes: usize) -> f64 {
    let config = PoolConfig::new(id, episodes).features(true).frames(None);
    let mut pool = Pool::new(popgym(), &config, &Threads::new(1).unwrap()).unwrap();
    let mut blocks = zeroed(pool.layout().blocks());
    pool.reset(ResetRequest::Seed(0), &mut blocks).unwrap();
    let mut experts = Experts::new(popgym(), id, episodes, Autoreset::NextStep).unwrap();
    let mut actions = vec![0; episodes * popgym().spec(id).unwrap().action_space.width()];
    let (mut returns, mut played): (Vec<Option<f64>>, _) = (vec![None; episodes], 0);
    while returns.iter().any(Option::is_none) {
        experts.act(&Batch::new(pool.layout(), &blocks), &mut actions).unwrap();
        pool.step(&actions, &mut blocks).unwrap();
        // No state of play is refused.
        let env = played % episodes;
        pool.restore(env, &pool.snapshot(env).unwrap()).unwrap();
        played += 1;
        let batch = Batch::new(pool.layout(), &blocks);
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

#[test]
fn ids_with_arguments_follow_the_rules() {
    for (id, is_played_by_experts) in [
        ("popgym-AutoencodeEasy-v0?num_decks=9", true),
        ("popgym-BattleshipEasy-v0?board_size=20&ship_sizes=20,1,5,5,4,3,3,2", false),
        ("popgym-BattleshipEasy-v0?board_size=5", true),
        ("popgym-ConcentrationEasy-v0?num_decks=9&deck_type=ranks", false),
        ("popgym-ConcentrationEasy-v0?num_decks=3", true),
        ("popgym-CountRecallEasy-v0?num_decks=63", true),
        ("popgym-LabyrinthEscapeEasy-v0?maze_dims=6,62&episode_length=2", true),
        ("popgym-LabyrinthExploreEasy-v0?maze_dims=62,6&episode_length=100", true),
        ("popgym-MultiarmedBanditEasy-v0?num_bandits=1000&episode_length=1", true),
        ("popgym-NoisyPositionOnlyCartPoleEasy-v0?noise_sigma=1e6&sutton_barto_reward=true", true),
        ("popgym-NoisyPositionOnlyPendulumEasy-v0?noise_sigma=0&g=-1000", true),
        ("popgym-RepeatPreviousEasy-v0?num_decks=9&k=467", true),
    ] {
        let outcomes = conformance::check(popgym(), id).unwrap();
        let broken: Vec<_> = outcomes.iter().filter(|outcome| outcome.problem.is_some()).collect();
        assert!(broken.is_empty(), "{id}: {broken:?}");
        assert!(!is_played_by_experts || expert_return(id, 2).is_finite());
    }
}
