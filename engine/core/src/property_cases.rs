//! How many cases the property tests of this crate and of `memory-gym` run.

use proptest::prelude::ProptestConfig;

/// `cases` runs of a property, unless the environment variable `PROPTEST_CASES` sets another number.
pub(crate) fn property_cases(cases: u32) -> ProptestConfig {
    let given = std::env::var("PROPTEST_CASES").ok().and_then(|cases| cases.parse().ok());
    ProptestConfig::with_cases(given.unwrap_or(cases))
}
