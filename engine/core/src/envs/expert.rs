//! The interface of the scripted experts, and their shared helpers.

/// Plays an environment from its feature and vector observations, and remembers what an agent would need to remember.
pub trait Expert: Send {
    /// Resets the expert's memory.
    fn reset(&mut self);

    /// Chooses an action. Must be called once for each observation, including the first of an episode.
    ///
    /// `features` and `vector_observation` are those that the environment writes; `action` has one number for each branch of
    /// the action space.
    fn act(&mut self, features: &[f32], vector_observation: &[f32], action: &mut [i32]);
}

/// Actions on a grid.
const NOTHING: i32 = 0;
const LEFT: i32 = 1;
const RIGHT: i32 = 2;
const AHEAD: i32 = 3;

/// The grid action that moves an agent with that heading, a unit vector, by `(x, y)` cells, horizontally first.
pub fn turn_or_walk([heading_x, heading_y]: [f32; 2], (x, y): (i32, i32)) -> i32 {
    let (wanted_x, wanted_y) = match (x, y) {
        (0, 0) => return NOTHING,
        (0, y) => (0.0, y.signum() as f32),
        (x, _) => (x.signum() as f32, 0.0),
    };
    let ahead = heading_x * wanted_x + heading_y * wanted_y;
    let clockwise = heading_x * wanted_y - heading_y * wanted_x;
    match () {
        _ if ahead > 0.5 => AHEAD,
        _ if clockwise > 0.5 => RIGHT,
        _ => LEFT,
    }
}
