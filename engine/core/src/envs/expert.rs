//! The interface of the scripted experts.

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
