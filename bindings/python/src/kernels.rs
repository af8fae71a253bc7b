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

/// Computes `outputs` and `saved` of a GRU layer.
#[pyfunction]
#[pyo3(signature = (inputs, weight, bias, state, sizes, resets, saved, outputs))]
#[allow(clippy::too_many_arguments)]
pub fn gru_forward(
    py: Python<'_>,
    inputs: Input<'_>,
    weight: Input<'_>,
    bias: Input<'_>,
    state: Input<'_>,
    sizes: Vec<usize>,
    resets: Vec<bool>,
    mut saved: Output<'_>,
    mut outputs: Output<'_>,
) -> PyResult<()> {
    let Sizes { sequences, steps, units, .. } = Sizes::new(&sizes, &resets, state.shape())?;
    expect("inputs", inputs.shape(), &[steps, 3 * units])?;
    expect("weight", weight.shape(), &[3 * units, units])?;
    expect("bias", bias.shape(), &[3 * units])?;
    expect("saved", saved.shape(), &[steps, gru::SAVED * units])?;
    expect("outputs", outputs.shape(), &[steps, units])?;
    let (inputs, weight, bias, state) = (inputs.as_slice()?, weight.as_slice()?, bias.as_slice()?, state.as_slice()?);
    let (saved, outputs) = (saved.as_slice_mut()?, outputs.as_slice_mut()?);
    py.detach(|| {
        WORKSPACE.with_borrow_mut(|Workspace { packed, gru, .. }| {
            packed.pack(Matrix::new(weight, units).t());
            gru::forward(sequences, inputs, packed, bias, state, saved, outputs, gru);
        });
    });
    Ok(())
}

/// Computes the gradients of the inputs and of the state of a GRU layer, and adds those of weight and bias.
#[pyfunction]
#[pyo3(signature = (weight, saved, grad_outputs, sizes, resets, grad_inputs, grad_weight, grad_bias, grad_state))]
#[allow(clippy::too_many_arguments)]
pub fn gru_backward(
    py: Python<'_>,
    weight: Input<'_>,
    saved: Input<'_>,
    grad_outputs: Input<'_>,
    sizes: Vec<usize>,
    resets: Vec<bool>,
    mut grad_inputs: Output<'_>,
    mut grad_weight: Output<'_>,
    mut grad_bias: Output<'_>,
    mut grad_state: Output<'_>,
) -> PyResult<()> {
    let Sizes { sequences, steps, units, .. } = Sizes::new(&sizes, &resets, grad_state.shape())?;
    expect("weight", weight.shape(), &[3 * units, units])?;
    expect("saved", saved.shape(), &[steps, gru::SAVED * units])?;
    expect("grad_outputs", grad_outputs.shape(), &[steps, units])?;
    expect("grad_inputs", grad_inputs.shape(), &[steps, 3 * units])?;
    expect("grad_weight", grad_weight.shape(), &[3 * units, units])?;
    expect("grad_bias", grad_bias.shape(), &[3 * units])?;
    let (weight, saved, grad_outputs) = (weight.as_slice()?, saved.as_slice()?, grad_outputs.as_slice()?);
    let (inputs, state) = (grad_inputs.as_slice_mut()?, grad_state.as_slice_mut()?);
    let (grad_weight, bias) = (grad_weight.as_slice_mut()?, grad_bias.as_slice_mut()?);
    py.detach(|| {
        WORKSPACE.with_borrow_mut(|Workspace { gru, .. }| {
            gru::backward(sequences, weight, saved, grad_outputs, inputs, grad_weight, bias, state, gru);
        });
    });
    Ok(())
}

/// Computes `outputs`, `cells` and `saved` of an LSTM layer.
#[pyfunction]
#[pyo3(signature = (inputs, weight, hidden, cell, sizes, resets, saved, outputs, cells))]
#[allow(clippy::too_many_arguments)]
pub fn lstm_forward(
    py: Python<'_>,
    inputs: Input<'_>,
    weight: Input<'_>,
    hidden: Input<'_>,
    cell: Input<'_>,
    sizes: Vec<usize>,
    resets: Vec<bool>,
    mut saved: Output<'_>,
    mut outputs: Output<'_>,
    mut cells: Output<'_>,
) -> PyResult<()> {
    let Sizes { sequences, steps, count, units } = Sizes::new(&sizes, &resets, hidden.shape())?;
    expect("inputs", inputs.shape(), &[steps, 4 * units])?;
    expect("weight", weight.shape(), &[4 * units, units])?;
    expect("cell", cell.shape(), &[count, units])?;
    expect("saved", saved.shape(), &[steps, lstm::SAVED * units])?;
    expect("outputs", outputs.shape(), &[steps, units])?;
    expect("cells", cells.shape(), &[steps, units])?;
    let (inputs, weight, hidden, cell) = (inputs.as_slice()?, weight.as_slice()?, hidden.as_slice()?, cell.as_slice()?);
    let (saved, outputs, cells) = (saved.as_slice_mut()?, outputs.as_slice_mut()?, cells.as_slice_mut()?);
    py.detach(|| {
        WORKSPACE.with_borrow_mut(|Workspace { packed, lstm, .. }| {
            packed.pack(Matrix::new(weight, units).t());
            lstm::forward(sequences, inputs, packed, hidden, cell, saved, outputs, cells, lstm);
        });
    });
    Ok(())
}

/// Computes the gradients of the inputs and of the states of an LSTM layer, and adds that of the weight.
#[pyfunction]
#[pyo3(signature = (weight, saved, grad_outputs, sizes, resets, grad_inputs, grad_weight, grad_hidden, grad_cell))]
#[allow(clippy::too_many_arguments)]
pub fn lstm_backward(
    py: Python<'_>,
    weight: Input<'_>,
    saved: Input<'_>,
    grad_outputs: Input<'_>,
    sizes: Vec<usize>,
    resets: Vec<bool>,
    mut grad_inputs: Output<'_>,
    mut grad_weight: Output<'_>,
    mut grad_hidden: Output<'_>,
    mut grad_cell: Output<'_>,
) -> PyResult<()> {
    let Sizes { sequences, steps, count, units } = Sizes::new(&sizes, &resets, grad_hidden.shape())?;
    expect("weight", weight.shape(), &[4 * units, units])?;
    expect("saved", saved.shape(), &[steps, lstm::SAVED * units])?;
    expect("grad_outputs", grad_outputs.shape(), &[steps, units])?;
    expect("grad_inputs", grad_inputs.shape(), &[steps, 4 * units])?;
    expect("grad_weight", grad_weight.shape(), &[4 * units, units])?;
    expect("grad_cell", grad_cell.shape(), &[count, units])?;
    let (weight, saved, grad_outputs) = (weight.as_slice()?, saved.as_slice()?, grad_outputs.as_slice()?);
    let (inputs, grad_weight) = (grad_inputs.as_slice_mut()?, grad_weight.as_slice_mut()?);
    let (hidden, cell) = (grad_hidden.as_slice_mut()?, grad_cell.as_slice_mut()?);
    py.detach(|| {
        WORKSPACE.with_borrow_mut(|Workspace { lstm, .. }| {
            lstm::backward(sequences, weight, saved, grad_outputs, inputs, grad_weight, hidden, cell, lstm);
        });
    });
    Ok(())
}

/// Computes `outputs` and `saved` of a minGRU layer.
#[pyfunction]
#[pyo3(signature = (inputs, state, sizes, resets, saved, outputs))]
pub fn mingru_forward(
    py: Python<'_>,
    inputs: Input<'_>,
    state: Input<'_>,
    sizes: Vec<usize>,
    resets: Vec<bool>,
    mut saved: Output<'_>,
    mut outputs: Output<'_>,
) -> PyResult<()> {
    let Sizes { sequences, steps, units, .. } = Sizes::new(&sizes, &resets, state.shape())?;
    expect("inputs", inputs.shape(), &[steps, 2 * units])?;
    expect("saved", saved.shape(), &[steps, mingru::SAVED * units])?;
    expect("outputs", outputs.shape(), &[steps, units])?;
    let (inputs, state) = (inputs.as_slice()?, state.as_slice()?);
    let (saved, outputs) = (saved.as_slice_mut()?, outputs.as_slice_mut()?);
    py.detach(|| mingru::forward(sequences, inputs, state, saved, outputs));
    Ok(())
}

/// Computes the gradients of the inputs and of the state of a minGRU layer.
#[pyfunction]
#[pyo3(signature = (inputs, saved, grad_outputs, sizes, resets, grad_inputs, grad_state))]
#[allow(clippy::too_many_arguments)]
pub fn mingru_backward(
    py: Python<'_>,
    inputs: Input<'_>,
    saved: Input<'_>,
    grad_outputs: Input<'_>,
    sizes: Vec<usize>,
    resets: Vec<bool>,
    mut grad_inputs: Output<'_>,
    mut grad_state: Output<'_>,
) -> PyResult<()> {
    let Sizes { sequences, steps, units, .. } = Sizes::new(&sizes, &resets, grad_state.shape())?;
    expect("inputs", inputs.shape(), &[steps, 2 * units])?;
    expect("saved", saved.shape(), &[steps, mingru::SAVED * units])?;
    expect("grad_outputs", grad_outputs.shape(), &[steps, units])?;
    expect("grad_inputs", grad_inputs.shape(), &[steps, 2 * units])?;
    let (inputs, saved, grad_outputs) = (inputs.as_slice()?, saved.as_slice()?, grad_outputs.as_slice()?);
    let (grad_inputs, grad_state) = (grad_inputs.as_slice_mut()?, grad_state.as_slice_mut()?);
    py.detach(|| mingru::backward(sequences, inputs, saved, grad_outputs, grad_inputs, grad_state));
    Ok(())
}
