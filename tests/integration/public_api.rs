//! The public API of the crate `endless-gym` is the list in `public_api.txt`, so that no change to it passes unnoticed.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::process::Command;

use public_api::Builder;
use serde_json::Value as Json;

/// The release of the compiler that writes the format of documentation which the library reads.
const RELEASE: &str = "rustc 1.95.";

#[test]
#[ignore = "slow"]
fn the_public_api_is_the_committed_list() {
    let version = Command::new("rustc").arg("--version").output().unwrap();
    let version = String::from_utf8(version.stdout).unwrap();
    if !version.starts_with(RELEASE) {
        assert_ne!(std::env::var("CI").as_deref(), Ok("true"), "{RELEASE} is needed, got {version}");
        println!("not run: {RELEASE} is needed, got {version}");
        return;
    }
    let facade = documentation("endless-gym");
    let sources = reexports(&facade);
    assert!(sources.len() > 100, "{sources:?}");
    let mut api: BTreeSet<String> = items(&facade).collect();
    for package in ["endless-gym-core", "endless-gym-memory-gym", "endless-gym-popgym", "endless-gym-service"] {
        // What a crate exports beyond that may change in any version.
        api.extend(items(&documentation(package)).filter(|item| sources.iter().any(|path| mentions(item, path))));
    }
    let committed: BTreeSet<_> = include_str!("public_api.txt").lines().map(str::to_owned).collect();
    let new = Path::new(env!("CARGO_TARGET_TMPDIR")).join("public_api.txt");
    std::fs::write(&new, api.iter().flat_map(|item| [item, "\n"]).collect::<String>()).unwrap();
    let removed = committed.difference(&api).map(|item| format!("- {item}\n"));
    let changes: String = removed.chain(api.difference(&committed).map(|item| format!("+ {item}\n"))).collect();
    assert!(
        changes.is_empty(),
        "the public API has changed: see RELEASING.md and, if it should, cp {} tests/integration/\n{changes}",
        new.display()
    );
}

/// The documentation of a crate as JSON, which the compiler offers only with unstable options.
fn documentation(package: &str) -> PathBuf {
    let target = Path::new(env!("CARGO_TARGET_TMPDIR")).join("api");
    let mut cargo = Command::new(env!("CARGO"));
    cargo.args(["rustdoc", "--quiet", "--locked", "--lib", "--package", package, "--target-dir"]).arg(&target);
    if package == "endless-gym" {
        // `program` would add the dependencies of the program, and no more than a function.
        cargo.args(["--no-default-features", "--features", "memory-gym,popgym,service"]);
    }
    cargo.args(["--", "-Zunstable-options", "--output-format=json", "--cap-lints=allow"]).env("RUSTC_BOOTSTRAP", "1");
    assert!(cargo.status().unwrap().success());
    target.join("doc").join(format!("{}.json", package.replace('-', "_")))
}

/// The paths of the items that a crate re-exports from other crates.
fn reexports(documentation: &Path) -> Vec<String> {
    let json: Json = serde_json::from_slice(&std::fs::read(documentation).unwrap()).unwrap();
    let items = json["index"].as_object().unwrap().values();
    items.filter_map(|item| Some(item["inner"]["use"]["source"].as_str()?.to_owned())).collect()
}

/// The public items of a crate, a line each.
fn items(documentation: &Path) -> impl Iterator<Item = String> {
    let builder = Builder::from_rustdoc_json(documentation);
    let builder = builder.omit_blanket_impls(true).omit_auto_trait_impls(true).omit_auto_derived_impls(true);
    builder.build().unwrap().into_items().map(|item| item.to_string())
}

/// Whether an item is at `path` or mentions what is there.
fn mentions(item: &str, path: &str) -> bool {
    let ends = |at: usize| !item[at + path.len()..].starts_with(|next: char| next.is_alphanumeric() || next == '_');
    item.match_indices(path).any(|(at, _)| ends(at))
}
