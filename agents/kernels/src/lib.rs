//! Layers of neural networks with their gradients, for learning on the CPU: fully connected layers, GRU, LSTM and minGRU.
//!
//! Each module has the functions `forward` and `backward` of one layer, with its equations. The caller owns all memory: weights,
//! outputs, gradients, and workspaces, which grow in the first call. Later calls with the same shapes do not allocate. Numbers are
//! f32, and matrices are stored row by row.
//!
//! The outputs and gradients equal those of PyTorch up to rounding; `agents/tests/test_agents_kernels.py` compares them. All sums have
//! a fixed order, and the results are the same on every CPU.

#![deny(unsafe_code)]

pub mod functions;
pub mod gru;
pub mod linear;
pub mod lstm;
pub mod matrix;
pub mod mingru;
pub mod sequences;
mod vectors;
