//! The recurrent layers of `endless-gym-kernels` on numpy arrays, without copies, for the PyTorch agents.
//!
//! Shapes are as in that crate, with the states before the first steps as (S, H), and `resets` as bool, (T, S) or (M,). All arrays are
//! contiguous, and others float32; those that a function overwrites are its last arguments.

use std::cell::RefCell;

use endless_gym_kernels::matrix::{Matrix, Packed};
use endless_gym_kernels::sequences::{Sequences, Workspace};
use endless_gym_kernels::{gru, lstm, mingru};
use numpy::{PyArrayMethods, PyReadonlyArrayDyn, PyReadwriteArrayDyn, PyUntypedArray, PyUntypedArrayMethods};
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;

type Input<'py> = PyReadonlyArrayDyn<'py, f32>;
type Output<'py> = PyReadwriteArrayDyn<'py, f32>;

thread_local! {
    static WORKSPACE: RefCell<(Packed, Workspace)> = RefCell::default();
}

/// Checks the shape of an argument, and that it is stored row by row.
fn expect(name: &str, array: &Bound<'_, PyUntypedArray>, expected: &[usize]) -> PyResult<()> {
    let shape = array.shape();
    if shape != expected {
        return Err(PyValueError::new_err(format!("{name} must have the shape {expected:?}, got {shape:?}")));
    }
    if !array.is_c_contiguous() {
        return Err(PyTypeError::new_err(format!(
            "{name} must be contiguous, row by row; use numpy.ascontiguousarray"
        )));
    }
    Ok(())
}

/// Defines a Python function of input arrays, the resets of sequences, and arrays that it overwrites, each with its shape. `of` names
/// the array whose rows are sequences and whose columns are units; after `=>` is what is computed from the slices.
macro_rules! kernel {
    (
        $(#[$doc:meta])*
        $name:ident($($input:ident: $input_shape:expr),*) -> ($($output:ident: $output_shape:expr),*),
        ($sequences:ident, $rows:ident, $count:ident, $units:ident) of $state:ident => $compute:expr
    ) => {
        $(#[$doc])*
        #[pyfunction]
        #[allow(clippy::too_many_arguments)]
        pub fn $name(
            py: Python<'_>,
            $($input: Input<'_>,)*
            resets: PyReadonlyArrayDyn<'_, bool>,
            $(mut $output: Output<'_>,)*
        ) -> PyResult<()> {
            let &[$count, $units @ 1..=usize::MAX] = $state.shape() else {
                let (name, shape) = (stringify!($state), $state.shape());
                let rule = format!("{name} must have the shape (sequences, 1 or more units), got {shape:?}");
                return Err(PyValueError::new_err(rule));
            };
            let ($rows, is_flat) = (resets.len(), resets.ndim() == 1);
            let shape = if is_flat { vec![$rows] } else { vec![$rows / $count.max(1), $count] };
            expect("resets", resets.as_untyped(), &shape)?;
            let $sequences = Sequences::new($count, resets.as_slice()?).map_err(PyValueError::new_err)?;
            $(expect(stringify!($input), $input.as_untyped(), &$input_shape)?;)*
            $(expect(stringify!($output), $output.as_untyped(), &$output_shape)?;)*
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
    (sequences, m, s, h) of state => WORKSPACE.with_borrow_mut(|(packed, workspace)| {
        packed.pack(Matrix::new(weight, h).t());
        gru::forward(sequences, inputs, packed, bias, state, saved, outputs, workspace);
    })
}

kernel! {
    /// Computes the gradients of the inputs and of the state of a GRU layer, and adds those of weight and bias.
    gru_backward(weight: [3 * h, h], saved: [m, gru::SAVED * h], grad_outputs: [m, h])
        -> (grad_inputs: [m, 3 * h], grad_weight: [3 * h, h], grad_bias: [3 * h], grad_state: [s, h]),
    (sequences, m, s, h) of grad_state => WORKSPACE.with_borrow_mut(|(_, workspace)| {
        gru::backward(sequences, weight, saved, grad_outputs, grad_inputs, grad_weight, grad_bias, grad_state, workspace);
    })
}

kernel! {
    /// Computes `outputs`, `cells` and `saved` of an LSTM layer.
    lstm_forward(inputs: [m, 4 * h], weight: [4 * h, h], hidden: [s, h], cell: [s, h])
        -> (saved: [m, lstm::SAVED * h], outputs: [m, h], cells: [m, h]),
    (sequences, m, s, h) of hidden => WORKSPACE.with_borrow_mut(|(packed, workspace)| {
        packed.pack(Matrix::new(weight, h).t());
        lstm::forward(sequences, inputs, packed, hidden, cell, saved, outputs, cells, workspace);
    })
}

kernel! {
    /// Computes the gradients of the inputs and of the states of an LSTM layer, and adds that of the weight.
    lstm_backward(weight: [4 * h, h], saved: [m, lstm::SAVED * h], grad_outputs: [m, h])
        -> (grad_inputs: [m, 4 * h], grad_weight: [4 * h, h], grad_hidden: [s, h], grad_cell: [s, h]),
    (sequences, m, s, h) of grad_hidden => WORKSPACE.with_borrow_mut(|(_, workspace)| {
        lstm::backward(sequences, weight, saved, grad_outputs, grad_inputs, grad_weight, grad_hidden, grad_cell, workspace);
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
