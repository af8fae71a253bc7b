//! Fork safety: values whose destructor must run only in the process that created them.

use std::ops::Deref;

/// Owns a port, a sample or a node. Dropping it in a forked child process does nothing: the destructor would remove files and
/// shared memory segments that the parent process still uses.
pub(crate) struct ForkGuard<T> {
    value: Option<T>,
    process: u32,
}

impl<T> ForkGuard<T> {
    pub(crate) fn new(value: T) -> Self {
        ForkGuard { value: Some(value), process: std::process::id() }
    }

    /// Whether this process created the value.
    pub(crate) fn is_owner(&self) -> bool {
        self.process == std::process::id()
    }

    /// Drops the value now, if this process created it. The value must not be used afterwards.
    pub(crate) fn drop_now(&mut self) {
        if self.is_owner() {
            self.value = None;
        }
    }
}

impl<T> Deref for ForkGuard<T> {
    type Target = T;

    fn deref(&self) -> &T {
        match &self.value {
            Some(value) => value,
            None => unreachable!("the value is present until it is dropped"),
        }
    }
}

impl<T> Drop for ForkGuard<T> {
    fn drop(&mut self) {
        if !self.is_owner() {
            std::mem::forget(self.value.take());
        }
    }
}

#[cfg(test)]
mod tests {
    use std::rc::Rc;

    use super::*;

    #[test]
    fn only_the_creating_process_drops_the_value() {
        let value = Rc::new(());
        drop(ForkGuard::new(Rc::clone(&value)));
        assert_eq!(Rc::strong_count(&value), 1);
        drop(ForkGuard { value: Some(Rc::clone(&value)), process: 0 });
        assert_eq!(Rc::strong_count(&value), 2);
        let mut inherited = ForkGuard { value: Some(Rc::clone(&value)), process: 0 };
        inherited.drop_now();
        assert!(!inherited.is_owner() && inherited.value.is_some());
    }
}
