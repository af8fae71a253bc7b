//! Runs the fuzz targets without a fuzzer: on each input of the corpus, on variations of them, and on arbitrary bytes.

use std::path::Path;

use endless_gym_fuzz::{Target, run};
use proptest::prelude::*;
use proptest::test_runner::{TestRunner, contextualize_config};

/// The recorded inputs of a target.
fn corpus(target: &str) -> Vec<Vec<u8>> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("corpus").join(target);
    let entries = std::fs::read_dir(&folder).unwrap_or_else(|error| panic!("{}: {error}", folder.display()));
    let mut files: Vec<_> = entries.map(|entry| entry.unwrap().path()).collect();
    files.sort();
    assert!(!files.is_empty(), "no inputs in {}", folder.display());
    files.iter().map(|file| std::fs::read(file).unwrap()).collect()
}

/// Replacements for a part of an input: other bytes, numbers that a forger would try, and JSON punctuation.
fn replacements() -> impl Strategy<Value = Vec<u8>> {
    let words =
        ["0", "-1", "64", "1e400", "18446744073709551615", "4294967296", "null", "[]", "{}", ",", "\"", "[", ""];
    prop_oneof![
        3 => prop::sample::select(words.to_vec()).prop_map(|word| word.as_bytes().to_vec()),
        1 => prop::collection::vec(any::<u8>(), 1..8),
        1 => any::<u32>().prop_map(|number| number.to_string().into_bytes()),
    ]
}

/// Inputs of the corpus with some parts replaced.
fn changed(corpus: Vec<Vec<u8>>) -> impl Strategy<Value = Vec<u8>> {
    let change = (any::<prop::sample::Index>(), 0..6_usize, replacements());
    (prop::sample::select(corpus), prop::collection::vec(change, 0..4)).prop_map(|(mut input, changes)| {
        for (place, length, replacement) in changes {
            let start = place.index(input.len() + 1);
            let end = (start + length).min(input.len());
            input.splice(start..end, replacement);
        }
        input
    })
}

fn check(name: &str, target: Target, cases: u32) {
    let corpus = corpus(name);
    corpus.iter().for_each(|input| run(target, input));
    let inputs = prop_oneof![changed(corpus), prop::collection::vec(any::<u8>(), 0..400)];
    let config = ProptestConfig { failure_persistence: None, ..ProptestConfig::with_cases(cases) };
    let mut runner = TestRunner::new(contextualize_config(config));
    runner
        .run(&inputs, |input| {
            run(target, &input);
            Ok(())
        })
        .unwrap_or_else(|error| panic!("{name}: {error}"));
}

/// A test for each target, with so many runs.
macro_rules! targets {
    ($($name:ident: $cases:literal,)*) => {
        $(
            #[test]
            fn $name() {
                check(stringify!($name), endless_gym_fuzz::$name::target, $cases);
            }
        )*
    };
}

targets! {
    actions: 150,
    checkpoints: 100,
    options: 150,
    snapshots: 150,
    traces: 300,
}
