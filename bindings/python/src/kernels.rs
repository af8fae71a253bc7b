//! The recurrent layers of `endless-gym-kernels` on numpy arrays, without copies, for the PyTorch agents.
//!
//! Shapes are as in that crate, with the states before the first steps as (S, H). All arrays are contiguous and float32; those that
//! a function overwrites are its last arguments.

use std::cell::RefCell;

use endless_gym_kernels::matrix::{Matrix, Packed};
use endless_gym_kernels::sequences::Sequences;
use endless_gym_kernels::{gru, lstm, mingru};
use numpy::{PyReadonlyArrayDyn, PyReadwriteArrayDyn, PyUntypedArrayMethods};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;

type Input<'py> = PyReadonlyArrayDyn<'py, f32>;
type Output<'py> = PyReadwriteArrayDyn<'py, f32>;

#[derive(Default)]
struct Workspace {
    packed: Packed,
    gru: gru::Workspace,
    lstm: lstm::Workspace,
}

thread_local! {
    static WORKSPACE: RefCell<Workspace> = RefCell::default();
}

/// M, S and H of a call.
struct Sizes<'a> {
    sequences: Sequences<'a>,
    steps: usize,
    count: usize,
    units: usize,
}

impl<'a> Sizes<'a> {
    fn new(sizes: &'a [usize], resets: &'a [bool], state: &[usize]) -> PyResult<Self> {
        let sequences = Sequences::new(sizes, resets).map_err(PyValueError::new_err)?;
        let (steps, count) = (sequences.steps(), sequences.count());
        match *state {
            [states, units] if states == count && units > 0 => Ok(Sizes { sequences, steps, count, units }),
            _ => Err(PyValueError::new_err(format!(
                "the state must have the shape (sequences, units) with {count} sequences, got {state:?}"
            ))),
        }
    }
}

/// Checks the shape of an argument.
fn expect(name: &str, shape: &[usize], expected: &[usize]) -> PyResult<()> {
    if shape == expected {
        return Ok(());
    }
    Err(PyValueError::new_err(format!("{name} must have the shape {expected:?}, got {shape:?}")))
}

/// Defines a Python function of input arrays, the sizes and resets of sequences, and arrays that it overwrites, each with its shape.
/// `of` names the array whose rows are sequences and whose columns are units; after `=>` is what is computed from the slices.
macro_rules! kernel {
    (
        $(#[$doc:meta])*
        $name:ident($($input:ident: $input_shape:expr),*) -> ($($output:ident: $output_shape:expr),*),
        ($sequences:ident, $steps:ident, $count:ident, $units:ident) of $state:ident => $compute:expr
    ) => {
        $(#[$doc])*
        #[pyfunction]
        #[allow(clippy::too_many_arguments)]
        pub fn $name(
            py: Python<'_>,
            $($input: Input<'_>,)*
            sizes: Vec<usize>,
            resets: Vec<bool>,
            $(mut $output: Output<'_>,)*
        ) -> PyResult<()> {
            let sizes = Sizes::new(&sizes, &resets, $state.shape())?;
            let Sizes { sequences: $sequences, steps: $steps, count: $count, units: $units } = sizes;
            $(expect(stringify!($input), $input.shape(), &$input_shape)?;)*
            $(expect(stringify!($output), $output.shape(), &$output_shape)?;)*
            $(let $input = $input.as_slice()?;)*
            $(let $output = $output.as_slice_mut()?;)*
            py.detach(|| $compute);
            Ok(())
        }
    };
}

kernel! {
    /// Computes `outputs` and `saved` of a GRU layer.
    gru_forward(inputs: [m, 3 * h], weight: [3 * h, h], bias: [3 * h], state: [s, h])
        -> (saved: [m, gru::SAVED * h], outputs: [m, h]),
    (sequences, m, s, h) of state => WORKSPACE.with_borrow_mut(|Workspace { packed, gru, .. }| {
        packed.pack(Matrix::new(weight, h).t());
        gru::forward(sequences, inputs, packed, bias, state, saved, outputs, gru);
    })
}

kernel! {
    /// Computes the gradients of the inputs and of the state of a GRU layer, and adds those of weight and bias.
    gru_backward(weight: [3 * h, h], saved: [m, gru::SAVED * h], grad_outputs: [m, h])
        -> (grad_inputs: [m, 3 * h], grad_weight: [3 * h, h], grad_bias: [3 * h], grad_state: [s, h]),
    (sequences, m, s, h) of grad_state => WORKSPACE.with_borrow_mut(|Workspace { gru, .. }| {
        gru::backward(sequences, weight, saved, grad_outputs, grad_inputs, grad_weight, grad_bias, grad_state, gru);
    })
}

kernel! {
    /// Computes `outputs`, `cells` and `saved` of an LSTM layer.
    lstm_forward(inputs: [m, 4 * h], weight: [4 * h, h], hidden: [s, h], cell: [s, h])
        -> (saved: [m, lstm::SAVED * h], outputs: [m, h], cells: [m, h]),
    (sequences, m, s, h) of hidden => WORKSPACE.with_borrow_mut(|Workspace { packed, lstm, .. }| {
        packed.pack(Matrix::new(weight, h).t());
        lstm::forward(sequences, inputs, packed, hidden, cell, saved, outputs, cells, lstm);
    })
}

kernel! {
    /// Computes the gradients of the inputs and of the states of an LSTM layer, and adds that of the weight.
    lstm_backward(weight: [4 * h, h], saved: [m, lstm::SAVED * h], grad_outputs: [m, h])
        -> (grad_inputs: [m, 4 * h], grad_weight: [4 * h, h], grad_hidden: [s, h], grad_cell: [s, h]),
    (sequences, m, s, h) of grad_hidden => WORKSPACE.with_borrow_mut(|Workspace { lstm, .. }| {
        lstm::backward(sequences, weight, saved, grad_outputs, grad_inputs, grad_weight, grad_hidden, grad_cell, lstm);
    })
}

kernel! {
    /// Computes `outputs` and `saved` of a minGRU layer.
    mingru_forward(inputs: [m, 2 * h], state: [s, h]) -> (saved: [m, mingru::SAVED * h], outputs: [m, h]),
    (sequences, m, s, h) of state => mingru::forward(sequences, inputs, state, saved, outputs)
}

kernel! {
    /// Computes the gradients of the inputs and of the state of a minGRU layer.
    mingru_backward(inputs: [m, 2 * h], saved: [m, mingru::SAVED * h], grad_outputs: [m, h])
        -> (grad_inputs: [m, 2 * h], grad_state: [s, h]),
    (sequences, m, s, h) of grad_state =>
        mingru::backward(sequences, inputs, saved, grad_outputs, grad_inputs, grad_state)
}
