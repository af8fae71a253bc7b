//! The environments of an extension module.

use std::sync::OnceLock;

use endless_gym::pool::Registry;

/// Every extension module is a shared object, with statics of its own.
pub static ENVIRONMENTS: OnceLock<Registry> = OnceLock::new();

pub fn environments() -> &'static Registry {
    ENVIRONMENTS.get_or_init(Registry::new)
}
