//! Gradients equal finite differences, nothing passes the start of an episode, and calls do not allocate once their workspaces have
//! grown.

use endless_gym_core::conformance::{CountingAllocator, allocations};
use endless_gym_core::random::Generator;
use endless_gym_kernels::matrix::{Matrix, Packed};
use endless_gym_kernels::sequences::{Sequences, Workspace};
use endless_gym_kernels::{gru, linear, lstm, mingru};

#[global_allocator]
static ALLOCATOR: CountingAllocator = CountingAllocator;

fn normals(random: &mut Generator, count: usize) -> Vec<f32> {
    (0..count).map(|_| random.standard_normal() as f32).collect()
}

fn size(random: &mut Generator, high: i64) -> usize {
    random.integers(1, high + 1) as usize
}

/// A number of random sequences and their resets: with or without episodes that start within them.
fn batch(random: &mut Generator) -> (usize, Vec<bool>) {
    let (count, length, has_resets) = (size(random, 10), size(random, 6), random.integers(0, 2) == 1);
    (count, (0..count * length).map(|_| has_resets && random.integers(0, 4) == 0).collect())
}

/// The shape of an argument: of M steps, S sequences, and a multiple of H units.
#[derive(Clone, Copy)]
enum Shape {
    /// (M, multiple of H)
    Inputs(usize),
    /// (S, H)
    State,
    /// (multiple of H, H)
    Weight(usize),
    /// (multiple of H,)
    Bias(usize),
}

use Shape::{Bias, Inputs, State, Weight};

/// A recurrent layer. Its arguments all have gradients; the first are the projected inputs.
struct Layer {
    name: &'static str,
    saved: usize,
    arguments: &'static [Shape],
    forward: fn(Sequences, &[Vec<f32>], &mut Memory),
    backward: fn(Sequences, &[Vec<f32>], &mut Memory),
}

/// Everything that calls write to, and the gradients of the outputs.
#[derive(Default)]
struct Memory {
    packed: Packed,
    saved: Vec<f32>,
    outputs: Vec<f32>,
    cells: Vec<f32>,
    grad_outputs: Vec<f32>,
    /// One for each argument.
    gradients: Vec<Vec<f32>>,
    workspace: Workspace,
}

const LAYERS: [Layer; 3] = [
    Layer {
        name: "gru",
        saved: gru::SAVED,
        arguments: &[Inputs(3), State, Weight(3), Bias(3)],
        forward: |sequences, arguments, memory| {
            let [inputs, state, weight, bias] = arguments else { unreachable!() };
            let Memory { packed, saved, outputs, workspace, .. } = memory;
            packed.pack(Matrix::new(weight, bias.len() / 3).t());
            gru::forward(sequences, inputs, packed, bias, state, saved, outputs, workspace);
        },
        backward: |sequences, arguments, memory| {
            let Memory { saved, grad_outputs, gradients, workspace, .. } = memory;
            let [inputs, state, weight, bias] = &mut gradients[..] else { unreachable!() };
            gru::backward(sequences, &arguments[2], saved, grad_outputs, inputs, weight, bias, state, workspace);
        },
    },
    Layer {
        name: "lstm",
        saved: lstm::SAVED,
        arguments: &[Inputs(4), State, State, Weight(4)],
        forward: |sequences, arguments, memory| {
            let [inputs, hidden, cell, weight] = arguments else { unreachable!() };
            let Memory { packed, saved, outputs, cells, workspace, .. } = memory;
            packed.pack(Matrix::new(weight, (weight.len() / 4).isqrt()).t());
            lstm::forward(sequences, inputs, packed, hidden, cell, saved, outputs, cells, workspace);
        },
        backward: |sequences, arguments, memory| {
            let Memory { saved, grad_outputs, gradients, workspace, .. } = memory;
            let [inputs, hidden, cell, weight] = &mut gradients[..] else { unreachable!() };
            lstm::backward(sequences, &arguments[3], saved, grad_outputs, inputs, weight, hidden, cell, workspace);
        },
    },
    Layer {
        name: "mingru",
        saved: mingru::SAVED,
        arguments: &[Inputs(2), State],
        forward: |sequences, arguments, memory| {
            mingru::forward(sequences, &arguments[0], &arguments[1], &mut memory.saved, &mut memory.outputs);
        },
        backward: |sequences, arguments, memory| {
            let Memory { saved, grad_outputs, gradients, .. } = memory;
            let [inputs, state] = &mut gradients[..] else { unreachable!() };
            mingru::backward(sequences, &arguments[0], saved, grad_outputs, inputs, state);
        },
    },
];

/// Random arguments of a layer, and its memory.
fn random_case(layer: &Layer, sequences: Sequences, units: usize, random: &mut Generator) -> (Vec<Vec<f32>>, Memory) {
    let (m, s) = (sequences.rows(), sequences.count());
    let arguments: Vec<_> = (layer.arguments.iter())
        .map(|shape| match shape {
            Inputs(multiple) => normals(random, m * multiple * units),
            State => normals(random, s * units),
            // Of usual size: with larger ones, the gradient changes much within a step of the differences.
            Weight(multiple) => {
                let deviation = 1.0 / (units as f32).sqrt();
                normals(random, multiple * units * units).iter().map(|x| x * deviation).collect()
            }
            Bias(multiple) => normals(random, multiple * units),
        })
        .collect();
    let memory = Memory {
        saved: vec![f32::NAN; m * layer.saved * units],
        outputs: vec![f32::NAN; m * units],
        cells: vec![f32::NAN; m * units],
        grad_outputs: normals(random, m * units),
        gradients: arguments.iter().map(|argument| vec![0.0; argument.len()]).collect(),
        ..Memory::default()
    };
    (arguments, memory)
}

fn dot(a: &[f32], b: &[f32]) -> f64 {
    a.iter().zip(b).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum()
}

/// Fails unless the derivative of `loss` at each argument, in a random direction, is as the gradients say.
fn check_gradients(
    name: &str,
    arguments: &mut [Vec<f32>],
    gradients: &[Vec<f32>],
    random: &mut Generator,
    mut loss: impl FnMut(&[Vec<f32>]) -> f64,
) {
    const STEP: f32 = 1.0 / 512.0;
    for index in 0..arguments.len() {
        let (point, direction) = (arguments[index].clone(), normals(random, arguments[index].len()));
        let mut at = |step: f32| {
            arguments[index] = point.iter().zip(&direction).map(|(x, d)| d.mul_add(step, *x)).collect();
            loss(arguments)
        };
        // Of fourth order.
        let difference = 8.0 * (at(STEP) - at(-STEP)) - (at(2.0 * STEP) - at(-2.0 * STEP));
        let derivative = difference / f64::from(12.0 * STEP);
        arguments[index] = point;
        let expected = dot(&gradients[index], &direction);
        let scale = dot(&gradients[index], &gradients[index]).sqrt();
        assert!(
            (derivative - expected).abs() <= 1e-3 * (1.0 + scale),
            "{name}, argument {index}: {derivative} instead of {expected}"
        );
    }
}

#[test]
fn gradients_of_recurrent_layers_equal_finite_differences() {
    let mut random = Generator::from_seed(2);
    for layer in &LAYERS {
        for case in 0..30 {
            let (count, resets) = if case == 0 { Default::default() } else { batch(&mut random) };
            let sequences = Sequences::new(count, &resets).unwrap();
            let units = size(&mut random, 20);
            let (mut arguments, mut memory) = random_case(layer, sequences, units, &mut random);
            (layer.forward)(sequences, &arguments, &mut memory);
            (layer.backward)(sequences, &arguments, &mut memory);
            let gradients = std::mem::take(&mut memory.gradients);
            check_gradients(layer.name, &mut arguments, &gradients, &mut random, |arguments| {
                (layer.forward)(sequences, arguments, &mut memory);
                dot(&memory.outputs, &memory.grad_outputs)
            });
        }
    }
}

#[test]
fn gradients_of_a_linear_layer_equal_finite_differences() {
    let mut random = Generator::from_seed(3);
    let mut packed = Packed::default();
    for _ in 0..30 {
        let (m, i, o) = (size(&mut random, 40), size(&mut random, 40), size(&mut random, 40));
        let mut arguments = [normals(&mut random, m * i), normals(&mut random, o * i), normals(&mut random, o)];
        let (grad_y, mut y) = (normals(&mut random, m * o), vec![f32::NAN; m * o]);
        let mut gradients = arguments.each_ref().map(|argument| vec![0.0; argument.len()]);
        let [grad_x, grad_weight, grad_bias] = &mut gradients;
        let [x, weight, _] = &arguments;
        linear::backward(x, weight, &grad_y, Some(grad_x), grad_weight, grad_bias, &mut packed);
        check_gradients("linear", &mut arguments, &gradients, &mut random, |arguments| {
            packed.pack(Matrix::new(&arguments[1], i).t());
            linear::forward(&arguments[0], &packed, &arguments[2], &mut y);
            dot(&y, &grad_y)
        });
    }
}

/// Rows `start`, `start + stride`, ... of a matrix with `rows` rows.
fn every(matrix: &[f32], rows: usize, start: usize, stride: usize, count: usize) -> Vec<f32> {
    let rows = matrix.chunks_exact(matrix.len() / rows);
    rows.skip(start).step_by(stride).take(count).flatten().copied().collect()
}

#[test]
fn episodes_within_sequences_equal_sequences_of_their_own() {
    let (mut random, count, length, units) = (Generator::from_seed(4), 5, 8, 19);
    for layer in &LAYERS {
        let resets: Vec<bool> = (0..count * length).map(|_| random.integers(0, 4) == 0).collect();
        assert!(resets[count..].iter().filter(|reset| **reset).count() > 4);
        let sequences = Sequences::new(count, &resets).unwrap();
        let (mut arguments, mut memory) = random_case(layer, sequences, units, &mut random);
        (layer.forward)(sequences, &arguments, &mut memory);
        (layer.backward)(sequences, &arguments, &mut memory);
        let whole = (arguments.clone(), std::mem::take(&mut memory.gradients));
        let mut sums: Vec<_> = arguments.iter().map(|argument| vec![0.0_f32; argument.len()]).collect();
        for sequence in 0..count {
            let mut start = 0;
            for end in 1..=length {
                if end < length && !resets[end * count + sequence] {
                    continue;
                }
                let (first, steps, is_reset) =
                    (start * count + sequence, end - start, resets[start * count + sequence]);
                start = end;
                let rows = |matrix: &[f32]| every(matrix, count * length, first, count, steps);
                let no_resets = vec![false; steps];
                let alone = Sequences::new(1, &no_resets).unwrap();
                let (_, mut memory_alone) = random_case(layer, alone, units, &mut random);
                memory_alone.grad_outputs = rows(&memory.grad_outputs);
                for ((argument, whole), shape) in arguments.iter_mut().zip(&whole.0).zip(layer.arguments) {
                    match shape {
                        Inputs(_) => *argument = rows(whole),
                        State if is_reset => *argument = vec![0.0; units],
                        State => *argument = every(whole, count, sequence, count, 1),
                        Weight(_) | Bias(_) => {}
                    }
                }
                (layer.forward)(alone, &arguments, &mut memory_alone);
                (layer.backward)(alone, &arguments, &mut memory_alone);
                assert_eq!(rows(&memory.outputs), memory_alone.outputs, "{}", layer.name);
                let gradients = memory_alone.gradients.iter().zip(&whole.1).zip(&mut sums).zip(layer.arguments);
                for (((alone, whole), sum), shape) in gradients {
                    match shape {
                        Inputs(_) => assert_eq!(*alone, rows(whole), "{}", layer.name),
                        State if !is_reset => sum[sequence * units..][..units].copy_from_slice(alone),
                        State => {}
                        Weight(_) | Bias(_) => sum.iter_mut().zip(alone).for_each(|(sum, x)| *sum += x),
                    }
                }
            }
        }
        for ((sum, whole), shape) in sums.iter().zip(&whole.1).zip(layer.arguments) {
            match shape {
                Inputs(_) => {}
                State => assert_eq!(sum, whole, "{}: gradients passed a reset", layer.name),
                Weight(_) | Bias(_) => {
                    let scale = whole.iter().fold(0.0, |max: f32, x| max.max(x.abs()));
                    assert!(sum.iter().zip(whole).all(|(a, b)| (a - b).abs() <= 1e-6 * scale), "{}", layer.name);
                }
            }
        }
    }
}

#[test]
fn calls_do_not_allocate_once_the_workspace_has_grown() {
    let mut random = Generator::from_seed(5);
    let sequences = Sequences::new(3, &[false; 9]).unwrap();
    let counted = |call: &mut dyn FnMut()| {
        let before = allocations();
        call();
        allocations() - before
    };
    for layer in &LAYERS {
        let (arguments, mut memory) = random_case(layer, sequences, 33, &mut random);
        let mut call = || {
            (layer.forward)(sequences, &arguments, &mut memory);
            (layer.backward)(sequences, &arguments, &mut memory);
        };
        let first = counted(&mut call);
        assert!(first > 0 || layer.name == "mingru", "{} needs no workspace?", layer.name);
        assert_eq!(counted(&mut call), 0, "{}", layer.name);
    }
    let (x, weight, bias) = (normals(&mut random, 8 * 5), normals(&mut random, 7 * 5), normals(&mut random, 7));
    let (mut y, mut packed) = (vec![0.0; 8 * 7], Packed::default());
    let (mut grad_x, mut grad_weight, mut grad_bias) = (x.clone(), weight.clone(), bias.clone());
    let mut call = || {
        packed.pack(Matrix::new(&weight, 5).t());
        linear::forward(&x, &packed, &bias, &mut y);
        linear::backward(&x, &weight, &y, Some(&mut grad_x), &mut grad_weight, &mut grad_bias, &mut packed);
    };
    assert!(counted(&mut call) > 0);
    assert_eq!(counted(&mut call), 0, "linear");
}
