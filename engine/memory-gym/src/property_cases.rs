//! How often the property tests of this crate run.

use proptest::prelude::ProptestConfig;

/// `cases` runs of a property, or as many as the environment variable `PROPTEST_CASES` says.
pub(crate) fn property_cases(cases: u32) -> ProptestConfig {
    let given = std::env::var("PROPTEST_CASES").ok().and_then(|cases| cases.parse().ok());
    ProptestConfig::with_cases(given.unwrap_or(cases))
}
