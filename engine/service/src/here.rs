//! Values whose destructor belongs to the process that made them.

use std::ops::Deref;

/// Owns a port or a sample. In a process that was forked off the one that made it, dropping it does nothing: the destructor
/// would remove files and segments that the parent still uses.
pub(super) struct Here<T> {
    value: Option<T>,
    process: u32,
}

impl<T> Here<T> {
    pub(super) fn new(value: T) -> Self {
        Here { value: Some(value), process: std::process::id() }
    }

    /// Drops the value before its time, after which it must not be used. Says whether this process may do that at all.
    pub(super) fn leave(&mut self) -> bool {
        let here = self.process == std::process::id();
        if here {
            self.value = None;
        }
        here
    }
}

impl<T> Deref for Here<T> {
    type Target = T;

    fn deref(&self) -> &T {
        match &self.value {
            Some(value) => value,
            None => unreachable!("the value is there until the drop"),
        }
    }
}

impl<T> Drop for Here<T> {
    fn drop(&mut self) {
        if self.process != std::process::id() {
            std::mem::forget(self.value.take());
        }
    }
}

#[cfg(test)]
mod tests {
    use std::rc::Rc;

    use super::*;

    #[test]
    fn only_the_process_that_made_a_value_drops_it() {
        let value = Rc::new(());
        drop(Here::new(Rc::clone(&value)));
        assert_eq!(Rc::strong_count(&value), 1);
        drop(Here { value: Some(Rc::clone(&value)), process: 0 });
        assert_eq!(Rc::strong_count(&value), 2);
        let mut elsewhere = Here { value: Some(()), process: 0 };
        assert!(!elsewhere.leave() && Here::new(()).leave());
    }
}
