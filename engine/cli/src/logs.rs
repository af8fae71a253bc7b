//! Logs on standard error.

use std::io;

use tracing_subscriber::filter::Targets;
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::util::SubscriberInitExt;

use crate::failure::Failure;

/// The environment variable that sets what to log.
const VARIABLE: &str = "ENDLESS_GYM_LOG";

/// Warnings by default, so that even a background engine reports what a person should know.
const DEFAULT: &str = "warn";

/// Starts logging as set by `given`, or else by the environment variable. Keeps a subscriber that the process already
/// has.
pub fn start(given: Option<&str>) -> Result<(), Failure> {
    let variable = std::env::var(VARIABLE).ok().filter(|text| !text.is_empty());
    let (name, text) = match (given, &variable) {
        (Some(text), _) => ("--log", text),
        (None, Some(text)) => (VARIABLE, &**text),
        (None, None) => ("--log", DEFAULT),
    };
    let filter = text.parse::<Targets>().map_err(|error| {
        format!(
            "{name} must be off, error, warn, info, debug, trace or a filter such as `endless_gym_service=debug`, got `{text}`: \
             {error}"
        )
    })?;
    let lines = tracing_subscriber::fmt::layer().with_writer(io::stderr).with_ansi(false);
    // Fails if the process already has a subscriber, such as that of the Python package.
    let _ = tracing_subscriber::registry().with(lines).with(filter).try_init();
    Ok(())
}
