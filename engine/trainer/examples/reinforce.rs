//! A trainer on the kernels and the service alone: REINFORCE (Williams, 1992) with a GRU, on environments that an engine serves.
//!
//! ```console
//! endless serve --env MortarMayhem-Grid-v0 --num-envs 64 --option command_count=[1] --features --no-frames --autoreset same-step
//! cargo run --release -p endless-gym-trainer --example reinforce [UPDATES] [ENGINE]
//! ```

use std::error::Error;
use std::time::Duration;

use endless_gym_core::pool::ResetRequest;
use endless_gym_core::random::Generator;
use endless_gym_kernels::adamw::AdamW;
use endless_gym_kernels::matrix::{Matrix, Packed};
use endless_gym_kernels::sequences::{Sequences, Workspace};
use endless_gym_kernels::{categorical, gru, linear};
use endless_gym_service::{ConnectConfig, Trainer};

const TIMEOUT: Duration = Duration::from_secs(10);
/// Steps between updates, and units of the GRU.
const STEPS: usize = 32;
const UNITS: usize = 64;

/// A weight (outputs, inputs) and a bias (outputs,), each with its gradient and its optimizer.
struct Layer(usize, [(Vec<f32>, Vec<f32>, AdamW); 2], Packed);

impl Layer {
    fn new(inputs: usize, outputs: usize, random: &mut Generator) -> Self {
        let mut part = |size: usize, scale: f32| {
            let initial = (0..size).map(|_| scale * random.standard_normal() as f32).collect();
            (initial, vec![0.0; size], AdamW::new(size))
        };
        Layer(inputs, [part(inputs * outputs, (inputs as f32).powf(-0.5)), part(outputs, 0.0)], Packed::default())
    }

    fn update(&mut self) {
        for (numbers, gradients, optimizer) in &mut self.1 {
            optimizer.update(numbers, gradients, 3e-3);
            gradients.fill(0.0);
        }
    }
}

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments = std::env::args().skip(1);
    let updates = arguments.next().map_or(Ok(200), |number| number.parse::<usize>())?;
    let engine = arguments.next().unwrap_or_else(|| "endless".to_owned());
    let mut trainer = Trainer::connect(&ConnectConfig::new(&engine).timeout(TIMEOUT))?;
    let (n, features) = (trainer.specification().num_envs, trainer.specification().features.len());
    let choices = [trainer.specification().action_space.branches()[0] as usize];
    let (rows, mut random) = (STEPS * n, Generator::from_seed(1));
    let mut layers = [(features, 3 * UNITS), (UNITS, 3 * UNITS), (UNITS, choices[0])]
        .map(|(inputs, outputs)| Layer::new(inputs, outputs, &mut random));
    let (mut x, mut projected) = (vec![0.0; rows * features], vec![0.0; rows * 3 * UNITS]);
    let (mut states, mut saved) = (vec![0.0; rows * UNITS], vec![0.0; rows * gru::SAVED * UNITS]);
    let (mut logits, mut actions) = (vec![0.0; rows * choices[0]], vec![0; rows]);
    let (mut rewards, mut starts) = (vec![0.0; rows], vec![true; rows + n]);
    let (mut state, mut workspace) = (vec![0.0; n * UNITS], Workspace::default());
    trainer.reset(0, ResetRequest::All)?;
    let mut lease = trainer.receive(0, TIMEOUT)?;
    for update in 1..=updates {
        layers.iter_mut().for_each(|Layer(inputs, [(w, ..), _], packed)| packed.pack(Matrix::new(w, *inputs).t()));
        for step in 0..STEPS {
            let part = |width: usize| step * n * width..(step + 1) * n * width;
            x[part(features)].copy_from_slice(lease.batch().features());
            let [input, hidden, policy] = &layers;
            linear::forward(&x[part(features)], &input.2, &input.1[1].0, &mut projected[part(3 * UNITS)]);
            let (now, saved) = (Sequences::new(n, &starts[part(1)])?, &mut saved[part(gru::SAVED * UNITS)]);
            let (gates, bias, after) = (&projected[part(3 * UNITS)], &hidden.1[1].0, &mut states[part(UNITS)]);
            gru::forward(now, gates, &hidden.2, bias, &state, saved, after, &mut workspace);
            state.copy_from_slice(after);
            let logits = &mut logits[part(choices[0])];
            linear::forward(&state, &policy.2, &policy.1[1].0, logits);
            categorical::log_softmax(logits, &choices);
            let noise: Vec<f32> = logits.iter().map(|_| categorical::gumbel(random.random_f32())).collect();
            categorical::sample(logits, &choices, Some(&noise), &mut actions[part(1)]);
            trainer.send_with(0, |sent| sent.iter_mut().zip(&actions[part(1)]).for_each(|(to, a)| *to = *a as i32))?;
            lease = trainer.receive(0, TIMEOUT)?;
            for (env, row) in part(1).enumerate() {
                (rewards[row], starts[row + n]) = (lease.batch().reward()[env] as f32, lease.batch().has_ended(env));
            }
        }
        // The discounted sums of the rewards of each episode, as far as it was played, less their mean.
        let mut returns = rewards.clone();
        (0..rows - n).rev().filter(|row| !starts[row + n]).for_each(|row| returns[row] += 0.9 * returns[row + n]);
        let mean = returns.iter().sum::<f32>() / rows as f32;
        let deviation = (returns.iter().map(|r| (r - mean).powi(2)).sum::<f32>() / rows as f32).sqrt() + 1e-6;
        // Minus the gradient of the mean of log-probability times return, and of the entropy with a small weight.
        let grad_taken: Vec<f32> = returns.iter().map(|r| -(r - mean) / deviation / rows as f32).collect();
        let (mut grad_logits, grad_entropy) = (vec![0.0; logits.len()], vec![-0.01 / rows as f32; rows]);
        categorical::backward(&logits, &choices, &actions, &grad_taken, &grad_entropy, &mut grad_logits);
        let (mut grad_states, mut grad_projected) = (vec![0.0; states.len()], vec![0.0; projected.len()]);
        let ([input, hidden, policy], mut packed) = (&mut layers, Packed::default());
        let [(w, dw, _), (_, db, _)] = &mut policy.1;
        linear::backward(&states, w, &grad_logits, Some(&mut grad_states), dw, db, &mut packed);
        let [(w, dw, _), (_, db, _)] = &mut hidden.1;
        let (all, mut grad_first) = (Sequences::new(n, &starts[..rows])?, vec![0.0; n * UNITS]);
        gru::backward(all, w, &saved, &grad_states, &mut grad_projected, dw, db, &mut grad_first, &mut workspace);
        let [(w, dw, _), (_, db, _)] = &mut input.1;
        linear::backward(&x, w, &grad_projected, None, dw, db, &mut packed);
        layers.iter_mut().for_each(Layer::update);
        let episodes = starts[n..].iter().filter(|start| **start).count() as f32;
        println!("update {update}: {:.4} per episode", rewards.iter().sum::<f32>() / episodes);
        starts.copy_within(rows.., 0);
    }
    Ok(())
}
