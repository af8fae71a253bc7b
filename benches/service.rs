//! Cost of a step through shared memory with an engine in a separate process, from sending actions to holding the
//! batch.

mod actions;

use std::process::{Child, Command, Stdio};
use std::time::Duration;

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use endless_gym::batch::zeroed;
use endless_gym::memory_gym;
use endless_gym::pool::{Pool, PoolConfig, ResetRequest, Seeding, Threads};
use endless_gym::service::{ConnectConfig, Trainer};

use actions::Actions;

const ID: &str = "Endless-MortarMayhem-v0";
const PATIENCE: Duration = Duration::from_secs(10);

/// An engine process that ends when this is dropped.
struct Engine(Child);

impl Drop for Engine {
    fn drop(&mut self) {
        // The engine ends when its standard input closes.
        drop(self.0.stdin.take());
        let _ = self.0.wait();
    }
}

fn service(criterion: &mut Criterion) {
    let spec = memory_gym().spec(ID).unwrap();
    let mut group = criterion.benchmark_group("service");
    for num_envs in [1, 64, 1024] {
        group.throughput(Throughput::Elements(num_envs as u64));
        let mut actions = Actions::new(spec, num_envs);

        // The step alone, for comparison.
        let config = PoolConfig::new(ID, num_envs).seeding(Seeding::Continue { seed: Some(1) });
        let mut pool = Pool::new(memory_gym(), &config, &Threads::new(1).unwrap()).unwrap();
        let mut batch = zeroed(pool.layout().blocks());
        pool.reset(ResetRequest::All, &mut batch).unwrap();
        group.bench_function(format!("in_process/{num_envs}"), |bencher| {
            bencher.iter(|| pool.step(actions.next(), &mut batch).unwrap());
        });

        let name = format!("endless-bench-{}", std::process::id());
        let arguments = ["serve", "--child", "--threads=1", "--seed=1", "--env", ID, "--service", &name];
        let _engine = Engine(
            Command::new(env!("CARGO_BIN_EXE_endless"))
                .args(arguments)
                .arg(format!("--num-envs={num_envs}"))
                .stdin(Stdio::piped())
                .stdout(Stdio::null())
                .spawn()
                .unwrap(),
        );
        let config = ConnectConfig::new(&name).timeout(PATIENCE);
        let mut trainer = Trainer::connect(&config).unwrap();
        trainer.reset(0, ResetRequest::All).unwrap();
        drop(trainer.receive(0, PATIENCE).unwrap());
        group.bench_function(format!("round_trip/{num_envs}"), |bencher| {
            bencher.iter(|| {
                trainer.send(0, actions.next()).unwrap();
                drop(trainer.receive(0, PATIENCE).unwrap());
            });
        });
    }
    group.finish();
}

criterion_group!(benches, service);
criterion_main!(benches);
