//! What a learner computes on the CPU, with gradients: layers (fully connected, GRU, LSTM, minGRU), categorical policies, the
//! losses of PPO, AdamW, orthogonal initial weights, the [`network`] of an agent made of these layers, and its [`file`](mod@file).
//!
//! The module of a layer has the functions `forward` and `backward`, with its equations. The caller owns all memory: weights,
//! outputs, gradients, and workspaces, which grow in the first call. Later calls with the same shapes do not allocate. Numbers are
//! f32, and matrices are stored row by row. Functions panic if shapes do not fit.
//!
//! The outputs and gradients equal those of PyTorch up to rounding: `agents/tests/test_agents_kernels.py` compares the recurrent
//! layers, and `tests/learning.rs` the rest. All sums have a fixed order.

#![deny(unsafe_code)]
#![expect(clippy::missing_errors_doc, clippy::missing_panics_doc, reason = "one line says what a section would")]

pub mod adamw;
pub mod categorical;
pub mod file;
pub mod functions;
pub mod gru;
pub mod linear;
pub mod lstm;
pub mod matrix;
pub mod mingru;
pub mod network;
pub mod orthogonal;
pub mod ppo;
pub mod sequences;
mod vectors;
