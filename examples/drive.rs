use endless_gym::batch::zeroed;
use endless_gym::envs;
use endless_gym::pool::{Pool, PoolConfig, ResetRequest, Seeding, Threads};
use rand::rngs::SmallRng;
use rand::{RngExt, SeedableRng};
use std::time::Instant;

#[inline(never)]
fn go(pool: &mut Pool, actions: &[i32], batch: &mut [endless_gym::batch::Block]) {
    pool.step(actions, batch).unwrap();
}

fn main() {
    let args: Vec<String> = std::env::args().collect();
    let num_envs: usize = args[2].parse().unwrap();
    let steps: usize = args[3].parse().unwrap();
    let warm: usize = args[4].parse().unwrap();
    let threads: usize = std::env::var("T").map_or(1, |t| t.parse().unwrap());
    for spec in envs::specs().filter(|s| args[1] == "all" || s.id == args[1]) {
        let config = PoolConfig { seeding: Seeding::Continue { seed: Some(1) }, ..PoolConfig::new(spec.id, num_envs) };
        let mut pool = Pool::new(&config, &Threads::new(threads).unwrap()).unwrap();
        let mut batch = zeroed(pool.layout().blocks());
        if std::env::var("THP").is_ok() {
            let p = batch.as_mut_ptr();
            let up = (p as usize).next_multiple_of(2 << 20);
            let len = batch.len() * 64 - (up - p as usize);
            unsafe {
                rustix::mm::madvise(up as *mut _, len, rustix::mm::Advice::LinuxHugepage).unwrap();
            }
        }
        pool.reset(ResetRequest::All, &mut batch).unwrap();
        let branches = spec.action_space.branches();
        let mut random = SmallRng::seed_from_u64(1);
        let mut actions = vec![vec![0; num_envs * branches.len()]; 251];
        for action in actions.iter_mut().flat_map(|actions| actions.chunks_exact_mut(branches.len())) {
            action.iter_mut().zip(branches).for_each(|(a, n)| *a = random.random_range(0..*n));
        }
        for s in 0..warm {
            pool.step(&actions[s % 251], &mut batch).unwrap();
        }
        let mut best = f64::MAX;
        let mut total = 0.0;
        let rounds = (steps / 50).max(1);
        let mut s = 0;
        for _ in 0..rounds {
            let start = Instant::now();
            for _ in 0..steps.min(50) {
                go(&mut pool, &actions[s % 251], &mut batch);
                s += 1;
            }
            let t = start.elapsed().as_secs_f64() * 1e9 / (steps.min(50) * num_envs) as f64;
            best = best.min(t);
            total += t;
        }
        println!("{:30} {:6} best {:7.1} mean {:7.1} ns/env", spec.id, num_envs, best, total / rounds as f64);
    }
}
