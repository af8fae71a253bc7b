//! The page's engine: one game that a person, an expert, a trained agent or a trace plays, and a wall of many
//! environments.
//!
//! [`module!`] makes a library of the type `cdylib` the engine of a page with the environments of a registry. A crate with
//! environments of its own depends on this one without its default features; the features `memory-gym`, the default, and `popgym`
//! define the engines with those of the suites:
//!
//! ```ignore
//! #[cfg(target_arch = "wasm32")]
//! endless_gym_web::module!(Registry::new().with::<TMaze>());
//! ```
//!
//! `endless page` builds such a crate and writes its page. `endless new` writes such a crate.
//!
//! The interface to JavaScript is a few functions that pass numbers. [`input`] allocates memory for a request: JSON, or
//! the bytes of a trace. [`call`] and [`open`] write their answer to [`output`]: JSON, an error's text or bytes.
//! JavaScript reads pictures directly from memory, as RGBA indexed \[row\]\[column\]. No function takes a pointer, so
//! nothing here is unsafe, and the page needs no generated code.

// The crate of the tests names it as users do.
#[cfg(test)]
extern crate endless_gym_core as endless_gym;

mod agent;
mod clues;
mod error;
mod game;
mod group;
mod pixels;
mod request;
mod wall;

use std::cell::RefCell;

use endless_gym_core::pool::{Registry, RegistryError};
use request::{App, Request};

#[cfg(feature = "memory-gym")]
module!(Ok(endless_gym_memory_gym::memory_gym().clone()));

#[cfg(all(feature = "popgym", not(feature = "memory-gym")))]
module!(Ok(endless_gym_popgym::popgym().clone()));

/// Defines the function that sets the environments of the page, those of `$registry`, a `Result<Registry, RegistryError>`.
#[macro_export]
macro_rules! module {
    ($registry:expr) => {
        /// Sets the environments of the page. JavaScript calls it first.
        #[unsafe(no_mangle)]
        pub extern "C" fn environments() -> u32 {
            $crate::populate($registry)
        }
    };
}

/// Sets the environments of the page; [`module!`] calls it. Returns the kind of the output, like [`call`].
pub fn populate(registry: Result<Registry, RegistryError>) -> u32 {
    reply(|app, _| request::set_environments(app, registry?))
}

/// What [`call`] and [`open`] return: the kind of data in [`output`].
#[derive(Clone, Copy, Debug, PartialEq)]
#[repr(u32)]
enum Kind {
    Json = 0,
    Error = 1,
    Bytes = 2,
}

thread_local! {
    static APP: RefCell<App> = RefCell::default();
    static INPUT: RefCell<Vec<u8>> = RefCell::default();
    static OUTPUT: RefCell<Vec<u8>> = RefCell::default();
}

/// Allocates memory for a request of `length` bytes.
#[unsafe(no_mangle)]
pub extern "C" fn input(length: usize) -> *mut u8 {
    INPUT.with_borrow_mut(|input| {
        input.clear();
        input.resize(length, 0);
        input.as_mut_ptr()
    })
}

/// Executes the JSON request in the input. Returns the kind of the output: 0 for JSON, 1 for the text of an error, 2
/// for bytes.
#[unsafe(no_mangle)]
pub extern "C" fn call() -> u32 {
    reply(|app, input| serde_json::from_slice::<Request>(input).map_err(error::WebError::Request)?.carry_out(app))
}

/// Opens the trace in the input, replays it, and makes it the game. Returns the kind of the output, like [`call`].
#[unsafe(no_mangle)]
pub extern "C" fn open() -> u32 {
    reply(request::open)
}

/// Reads the agent in the input, a checkpoint of `endless learn` or a file that `endless_gym_agents.export` writes. Returns
/// the kind of the output, like [`call`].
#[unsafe(no_mangle)]
pub extern "C" fn load_agent() -> u32 {
    reply(request::load_agent)
}

/// The answer to the last call, or after a trap the panic's message.
#[unsafe(no_mangle)]
pub extern "C" fn output() -> *const u8 {
    OUTPUT.with_borrow(Vec::as_ptr)
}

/// Length of [`output`] in bytes.
#[unsafe(no_mangle)]
pub extern "C" fn output_length() -> usize {
    OUTPUT.with_borrow(Vec::len)
}

/// The game's observation: RGBA of the frame's size; null without a game.
#[unsafe(no_mangle)]
pub extern "C" fn observation() -> *const u8 {
    APP.with_borrow(|app| app.game.as_ref().map_or(std::ptr::null(), |game| game.observation().as_ptr()))
}

/// The game's ground-truth view, not magnified: RGBA of the frame's size; null without a game.
#[unsafe(no_mangle)]
pub extern "C" fn view() -> *const u8 {
    APP.with_borrow(|app| app.game.as_ref().map_or(std::ptr::null(), |game| game.view().as_ptr()))
}

/// Steps every environment of the wall `count` times. Returns the kind of the output, like [`call`].
#[unsafe(no_mangle)]
pub extern "C" fn step_wall(count: u32) -> u32 {
    reply(|app, _| request::step_wall(app, count))
}

/// Draws the wall as RGBA, of the size in the answer to the wall's request; null without a wall.
#[unsafe(no_mangle)]
pub extern "C" fn draw_wall() -> *const u8 {
    APP.with_borrow_mut(|app| app.wall.as_mut().map_or(std::ptr::null(), |wall| wall.draw().as_ptr()))
}

fn reply(answer: impl FnOnce(&mut App, &[u8]) -> Result<request::Reply, error::WebError>) -> u32 {
    // Keep a panic's message, since JavaScript sees only a trap.
    #[cfg(target_arch = "wasm32")]
    std::panic::set_hook(Box::new(|panic| {
        let said = panic.to_string().into_bytes();
        OUTPUT.with(|output| output.try_borrow_mut().map(|mut output| *output = said).unwrap_or_default());
    }));
    let answer = INPUT.with_borrow(|input| APP.with_borrow_mut(|app| answer(app, input)));
    let (kind, bytes) = match answer {
        Ok(request::Reply::Json(json)) => (Kind::Json, json.to_string().into_bytes()),
        Ok(request::Reply::Bytes(bytes)) => (Kind::Bytes, bytes),
        Err(error) => (Kind::Error, error.to_string().into_bytes()),
    };
    OUTPUT.set(bytes);
    kind as u32
}

#[cfg(test)]
mod tests;
