//! What an engine has done.

/// What an engine has done.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct EngineSummary {
    /// Batches sent, including those of resets.
    pub batches: u64,
    /// Steps, summed over the environments.
    pub env_steps: u64,
    /// Episodes that have ended.
    pub episodes: u64,
    /// Requests that were rejected.
    pub rejected: u64,
    /// Requests for an earlier incarnation, which were ignored.
    pub dropped: u64,
    /// Batches that no process received.
    pub undelivered: u64,
    /// Dead processes whose resources the engine removed.
    pub recoveries: u64,
}
