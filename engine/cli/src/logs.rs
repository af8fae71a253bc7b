//! Logs on standard error.

use std::io;

use tracing_subscriber::filter::Targets;
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::util::SubscriberInitExt;

use super::failure::Failure;

/// The environment variable that says what to log.
const VARIABLE: &str = "ENDLESS_GYM_LOG";

/// What is logged by default: also an engine in the background reports what a person should know.
const DEFAULT: &str = "warn";

/// Starts logging what `given` says, or else the environment variable. A subscriber that the process already has is kept.
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
    // An error means that the process has a subscriber, such as that of the Python package.
    let _ = tracing_subscriber::registry().with(lines).with(filter).try_init();
    Ok(())
}
