//! Recorded traces, random options and formats.

use std::path::{Path, PathBuf};

use endless_gym::batch::PixelFormat;
use endless_gym::envs::{EnvSpec, Parameter, ParameterKind};
use proptest::prelude::*;
use proptest::test_runner::contextualize_config;
use serde_json::{Map, Value as Json};

/// Checks all items at once, each in a thread of its own.
pub fn check_at_once<T: Send>(items: impl Iterator<Item = T>, check: impl Fn(T) + Sync) {
    let check = &check;
    std::thread::scope(|scope| {
        for item in items {
            scope.spawn(move || check(item));
        }
    });
}

/// The recorded traces of an id.
pub fn traces(id: &str) -> Vec<PathBuf> {
    traces_in("traces", id)
}

/// The recorded traces of an id with checksums of ground-truth views.
pub fn traces_with_views(id: &str) -> Vec<PathBuf> {
    traces_in("views", id)
}

/// The folder of the recordings; its README.md describes them.
pub fn reference() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/reference")
}

fn traces_in(folder: &str, id: &str) -> Vec<PathBuf> {
    let folder = reference().join(folder);
    let entries = std::fs::read_dir(&folder).unwrap_or_else(|error| panic!("{}: {error}", folder.display()));
    let mut files: Vec<_> = entries
        .map(|entry| entry.unwrap().path())
        .filter(|path| {
            let name = path.file_name().unwrap().to_string_lossy().into_owned();
            name.starts_with(&format!("{id}.")) && name.ends_with(".json.gz")
        })
        .collect();
    files.sort();
    assert!(!files.is_empty(), "no traces of {id} in {}", folder.display());
    files
}

/// Any value within the parameter's limits, mostly not far from the default.
fn value(parameter: &Parameter) -> BoxedStrategy<Json> {
    match parameter.kind {
        ParameterKind::Choice { choices, .. } => prop::sample::select(choices).prop_map(Json::from).boxed(),
        ParameterKind::Bool { .. } => any::<bool>().prop_map(Json::from).boxed(),
        ParameterKind::Int { default, min, max } => {
            let near = (2 * default.abs() + 200).clamp(min, max);
            (min.max(-1)..=near).prop_map(Json::from).boxed()
        }
        ParameterKind::Float { default, min, max } => {
            let reach = 2.0 * default.abs() + 0.1;
            let near = (default - reach).max(min)..=(default + reach).min(max);
            prop_oneof![8 => near, 1 => min..=max, 1 => Just(min)].prop_map(Json::from).boxed()
        }
        ParameterKind::IntList { default, min, max } => {
            let near = (2 * default.iter().max().unwrap_or(&min) + 1).clamp(min, max);
            prop::collection::vec(min..=near, 1..4).prop_map(Json::from).boxed()
        }
    }
}

/// Any set of options within the limits.
pub fn options(spec: &'static EnvSpec) -> impl Strategy<Value = Map<String, Json>> {
    let options: Vec<_> = spec
        .parameters
        .iter()
        .map(|parameter| {
            let name = parameter.name;
            prop::option::weighted(0.3, value(parameter)).prop_map(move |value| value.map(|value| (name, value)))
        })
        .collect();
    options.prop_map(|options| options.into_iter().flatten().map(|(name, value)| (name.to_owned(), value)).collect())
}

/// All pixel formats.
pub fn pixel_formats() -> impl Iterator<Item = PixelFormat> {
    (0..8).map(|bits| PixelFormat { grayscale: bits & 1 != 0, channels_first: bits & 2 != 0, row_major: bits & 4 != 0 })
}

/// Any pixel format.
pub fn pixel_format() -> impl Strategy<Value = PixelFormat> {
    prop::sample::select(pixel_formats().collect::<Vec<_>>())
}

/// The number of runs of a property: the environment variable `PROPTEST_CASES`, or else `cases`.
pub fn property_cases(cases: u32) -> ProptestConfig {
    contextualize_config(ProptestConfig::with_cases(cases))
}
