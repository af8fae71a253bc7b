//! The outcomes of rounds, and the summary of a run.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

/// Something that must not happen.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Failure {
    pub kind: String,
    /// The fault that was being executed.
    pub fault: String,
    pub text: String,
}

/// The outcome of a round.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Outcome {
    /// The kind of each fault, and the time in milliseconds from its end to the next correct batch.
    pub faults: Vec<(String, Option<f64>)>,
    pub failures: Vec<Failure>,
    /// The errors that processes reported.
    pub errors: BTreeMap<String, u64>,
    /// Batches that trainers compared with their twins'.
    pub batches: u64,
    /// Batches of observers compared with a trainer's.
    pub observed: u64,
    /// Messages that pages have shown.
    pub shown: u64,
    /// Faults that the machine does not permit, by kind.
    pub left_out: BTreeMap<String, u64>,
}

impl Outcome {
    /// Adds a round's outcome.
    pub fn add(&mut self, other: Outcome) {
        self.faults.extend(other.faults);
        self.failures.extend(other.failures);
        self.batches += other.batches;
        self.observed += other.observed;
        self.shown += other.shown;
        for (sums, counts) in [(&mut self.errors, other.errors), (&mut self.left_out, other.left_out)] {
            for (kind, count) in counts {
                *sums.entry(kind).or_default() += count;
            }
        }
    }

    /// Prints the summary.
    pub fn print(&self) {
        println!("\n{:34} {:>7} {:>9} {:>9}  recovery in milliseconds", "fault", "faults", "median", "max");
        let mut kinds = BTreeMap::<_, Vec<_>>::new();
        for (kind, time) in &self.faults {
            kinds.entry(kind.as_str()).or_default().push(*time);
        }
        let all = ("all", self.faults.iter().map(|(_, time)| *time).collect());
        for (kind, times) in kinds.into_iter().chain([all]) {
            let count = times.len();
            let mut times: Vec<f64> = times.into_iter().flatten().collect();
            times.sort_by(f64::total_cmp);
            match (times.get(times.len() / 2), times.last()) {
                (Some(median), Some(max)) => println!("{kind:34} {count:>7} {median:>9.0} {max:>9.0}"),
                _ => println!("{kind:34} {count:>7}"),
            }
        }
        println!("\nbatches compared: {} of trainers, {} of observers", self.batches, self.observed);
        let errors: Vec<_> = self.errors.iter().map(|(kind, count)| format!("{kind} {count}")).collect();
        println!("errors that were reported: {}", errors.join(", "));
        for (kind, count) in &self.left_out {
            println!("left out, since this machine does not permit it: {kind} ({count})");
        }
        let mut failures = BTreeMap::<_, u64>::new();
        for failure in &self.failures {
            *failures.entry((&failure.kind, &failure.fault)).or_default() += 1;
        }
        for ((kind, fault), count) in &failures {
            println!("FAILED {count} times: {kind} after: {fault}");
        }
        println!("{} faults, {} failures", self.faults.len(), self.failures.len());
    }
}
