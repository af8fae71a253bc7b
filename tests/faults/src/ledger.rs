//! Records which batches the trainers of a round received: none may be missing or repeated.

use std::collections::BTreeMap;

/// The range of a group's batches that one trainer reported.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Span {
    first: u64,
    last: u64,
}

/// The batches of every run of the engine, by group and trainer.
///
/// It is checked after all reports have been read, since a killed trainer's may still be in its pipe while its
/// successor plays.
#[derive(Debug, Default)]
pub struct Ledger(BTreeMap<(u64, usize), BTreeMap<u64, Span>>);

impl Ledger {
    /// The trainer with this number has received a batch. Each trainer itself checks that its batches have no gaps.
    pub fn add(&mut self, incarnation: u64, group: usize, trainer: u64, step: u64) {
        let spans = self.0.entry((incarnation, group)).or_default();
        let span = spans.entry(trainer).or_insert(Span { first: step, last: step });
        (span.first, span.last) = (span.first.min(step), span.last.max(step));
    }

    /// The missing and repeated batches. Trainers are numbered in the order of their start. Each may have received or
    /// requested one batch of a group without reporting it.
    pub fn faults(&self) -> Vec<String> {
        let mut found = Vec::new();
        for ((_, group), spans) in &self.0 {
            // The first trainer in the ledger may follow others that reported nothing.
            for ((old, before), (new, after)) in spans.iter().zip(spans.iter().skip(1)) {
                let unknown = new - old;
                if !(before.last + 1..=before.last + 1 + unknown).contains(&after.first) {
                    found.push(format!(
                        "group {group}: the first batch of trainer {new} is {}, after {} of trainer {old}",
                        after.first, before.last
                    ));
                }
            }
            if let Some((number, span)) = spans.first_key_value().filter(|(number, span)| span.first > **number + 1) {
                found.push(format!("group {group}: the first batch of trainer {number} is {}", span.first));
            }
        }
        found
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn faults(batches: &[(u64, u64)]) -> usize {
        let mut ledger = Ledger::default();
        batches.iter().for_each(|(trainer, step)| ledger.add(7, 0, *trainer, *step));
        ledger.faults().len()
    }

    #[test]
    fn each_trainer_may_leave_one_batch_unreported() {
        assert_eq!(faults(&[(0, 1), (0, 2), (1, 3)]), 0);
        assert_eq!(faults(&[(0, 1), (0, 2), (1, 4)]), 0);
        assert_eq!(faults(&[(0, 1), (0, 2), (1, 5)]), 1);
        assert_eq!(faults(&[(0, 1), (0, 2), (2, 5)]), 0);
        assert_eq!(faults(&[(0, 1), (0, 2), (1, 2)]), 1);
        assert_eq!(faults(&[(1, 2)]), 0);
        assert_eq!(faults(&[(1, 3)]), 1);
    }

    #[test]
    fn reports_may_be_read_late() {
        assert_eq!(faults(&[(0, 1), (1, 4), (0, 2), (1, 5), (0, 3)]), 0);
    }
}
