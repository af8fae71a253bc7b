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
