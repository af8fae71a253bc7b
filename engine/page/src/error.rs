//! Errors of the servers.

/// Why a page cannot be served.
#[derive(Debug, thiserror::Error)]
pub enum ServerError {
    /// The port cannot be used.
    #[error("cannot listen on 127.0.0.1:{port}: {reason}; give another --port, or 0 for any that is free")]
    Port {
        /// The port that was given.
        port: u16,
        /// The operating system's reason.
        reason: std::io::Error,
    },
    /// This program does not include the page that plays the environments.
    #[error(
        "this program was built without the page that plays the environments: play in the terminal with `--terminal`; for the page, run \
         `cargo xtask play` in a clone, or write the page of your own crate with `endless page --out FOLDER`"
    )]
    PageNotBuilt,
    /// The page of this program does not have the environment.
    #[error(
        "`{id}` is not on the page of this program: play it in the terminal with `--terminal`, or write the page of your own crate \
         with `endless page --out FOLDER`"
    )]
    NotOnPage {
        /// The environment's id.
        id: String,
    },
    /// The server cannot run.
    #[error("the web server cannot run: {reason}")]
    Server {
        /// The operating system's reason.
        reason: std::io::Error,
    },
}
