//! Import cycles: a file of the crates under `engine/` imports only files that do not, directly or through others, import it.
//!
//! A file is a node. A path that begins with `crate`, `self`, `super` or a child module is an edge to the deepest file that it
//! names. A folder's `mod.rs` is a node too, so files of a folder import each other by name and not through it.
//! Tests are ignored.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use syn::visit::{self, Visit};

use crate::venv::workspace;

/// A module's path within its crate; empty for the root.
type Module = Vec<String>;

/// Which modules each module imports.
type Imports = BTreeMap<Module, BTreeSet<Module>>;

/// Fails if the files of a crate import each other in a cycle.
pub fn check() -> Result<(), String> {
    println!("==> import cycles");
    let mut cycles = Vec::new();
    for name in ["engine/core", "engine/service", "engine/view", "engine/cli", "tests/faults"] {
        let crate_root = workspace().join(name).join("src");
        let mut files = BTreeMap::new();
        collect(&crate_root, &[], &mut files)?;
        let modules: BTreeSet<Module> = files.keys().cloned().collect();
        let imports = files.iter().map(|(module, file)| (module.clone(), imports_of(module, file, &modules))).collect();
        cycles.extend(in_cycles(&imports).iter().map(|(from, to)| format!("{name}: {} -> {}", show(from), show(to))));
    }
    if cycles.is_empty() { Ok(()) } else { Err(format!("files import each other in a cycle:\n{}", cycles.join("\n"))) }
}

/// Parses all files below a folder, the module `module`.
fn collect(folder: &Path, module: &[String], files: &mut BTreeMap<Module, syn::File>) -> Result<(), String> {
    let entries = std::fs::read_dir(folder).map_err(|error| format!("{}: {error}", folder.display()))?;
    for entry in entries {
        let path = entry.map_err(|error| format!("{}: {error}", folder.display()))?.path();
        let stem = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        let child = [module, std::slice::from_ref(&stem)].concat();
        if path.is_dir() {
            collect(&path, &child, files)?;
        } else if path.extension().is_some_and(|extension| extension == "rs") && !stem.ends_with("tests") {
            let text = std::fs::read_to_string(&path).map_err(|error| format!("{}: {error}", path.display()))?;
            let file = syn::parse_file(&text).map_err(|error| format!("{}: {error}", path.display()))?;
            files.insert(if stem == "lib" || stem == "mod" { module.to_vec() } else { child }, file);
        }
    }
    Ok(())
}

/// The modules that a file's paths name.
fn imports_of(module: &Module, file: &syn::File, modules: &BTreeSet<Module>) -> BTreeSet<Module> {
    let mut paths = Paths::default();
    paths.visit_file(file);
    paths.0.iter().filter_map(|path| resolve(module, path, modules)).filter(|target| target != module).collect()
}

/// The deepest module that a path names, if it is one of this crate.
fn resolve(module: &Module, path: &[String], modules: &BTreeSet<Module>) -> Option<Module> {
    let mut base = module.clone();
    let mut rest = path;
    match path.first()?.as_str() {
        "crate" => (base, rest) = (Module::new(), &path[1..]),
        "self" => rest = &path[1..],
        "super" => {
            while let Some((_, tail)) = rest.split_first().filter(|(first, _)| *first == "super") {
                base.pop();
                rest = tail;
            }
        }
        // A module names its children without a prefix.
        child if modules.contains(&[base.as_slice(), &[child.to_owned()]].concat()) => {}
        _ => return None,
    }
    for segment in rest {
        base.push(segment.clone());
        if !modules.contains(&base) {
            base.pop();
            break;
        }
    }
    Some(base)
}

/// All edges that are part of a cycle: those whose target imports, directly or through others, their source.
fn in_cycles(imports: &Imports) -> Vec<(Module, Module)> {
    let edges = imports.iter().flat_map(|(from, targets)| targets.iter().map(move |to| (from, to)));
    edges.filter(|(from, to)| reaches(imports, to, from)).map(|(from, to)| (from.clone(), to.clone())).collect()
}

fn reaches(imports: &Imports, from: &Module, to: &Module) -> bool {
    let (mut seen, mut open) = (BTreeSet::new(), vec![from]);
    while let Some(module) = open.pop() {
        if module == to {
            return true;
        }
        if seen.insert(module) {
            open.extend(imports.get(module).into_iter().flatten());
        }
    }
    false
}

fn show(module: &Module) -> String {
    if module.is_empty() { "lib".to_owned() } else { module.join("/") }
}

/// Collects the paths of a file's imports and expressions, without those of tests.
#[derive(Default)]
struct Paths(Vec<Vec<String>>);

impl Paths {
    fn add_tree(&mut self, prefix: &[String], tree: &syn::UseTree) {
        let with = |name: &syn::Ident| [prefix, &[name.to_string()]].concat();
        match tree {
            syn::UseTree::Path(path) => self.add_tree(&with(&path.ident), &path.tree),
            syn::UseTree::Name(name) => self.0.push(with(&name.ident)),
            syn::UseTree::Rename(name) => self.0.push(with(&name.ident)),
            syn::UseTree::Glob(_) => self.0.push(prefix.to_vec()),
            syn::UseTree::Group(group) => group.items.iter().for_each(|item| self.add_tree(prefix, item)),
        }
    }
}

impl Visit<'_> for Paths {
    fn visit_item_use(&mut self, item: &syn::ItemUse) {
        self.add_tree(&[], &item.tree);
    }

    fn visit_item_mod(&mut self, item: &syn::ItemMod) {
        if !item.attrs.iter().any(|attribute| attribute.path().is_ident("cfg")) {
            visit::visit_item_mod(self, item);
        }
    }

    fn visit_path(&mut self, path: &syn::Path) {
        let segments: Vec<String> = path.segments.iter().map(|segment| segment.ident.to_string()).collect();
        if segments.len() > 1 {
            self.0.push(segments);
        }
        visit::visit_path(self, path);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn module(path: &str) -> Module {
        path.split('/').filter(|part| !part.is_empty()).map(str::to_owned).collect()
    }

    fn imports(files: &[(&str, &str)]) -> Imports {
        let modules: BTreeSet<Module> = files.iter().map(|(path, _)| module(path)).collect();
        let parse = |text: &str| syn::parse_file(text).unwrap();
        files.iter().map(|(path, text)| (module(path), imports_of(&module(path), &parse(text), &modules))).collect()
    }

    #[test]
    fn paths_name_files() {
        let files = [
            ("", "mod a; mod b; pub use a::x::Y;"),
            ("a", "pub mod x; use crate::b::{Z, other::*};"),
            ("a/x", "fn f() -> super::super::b::Z { crate::a::g() } #[cfg(test)] mod tests { use super::super::y; }"),
            ("b", "use std::fmt; use super::a::x;"),
        ];
        let expected = [("", vec!["a/x"]), ("a", vec!["b"]), ("a/x", vec!["a", "b"]), ("b", vec!["a/x"])];
        for (from, to) in expected {
            assert_eq!(imports(&files)[&module(from)], to.into_iter().map(module).collect(), "{from}");
        }
    }

    #[test]
    fn a_path_that_begins_with_a_child_is_an_import() {
        let files = [("a", "mod x; struct S(x::T, y::U);"), ("a/x", "use super::f;"), ("y", "")];
        assert_eq!(imports(&files)[&module("a")], [module("a/x")].into());
        assert_eq!(in_cycles(&imports(&files)), [(module("a"), module("a/x")), (module("a/x"), module("a"))]);
    }

    #[test]
    fn only_cycles_are_reported() {
        let chain = [("a", "use crate::b;"), ("b", "use crate::c;"), ("c", "")];
        assert_eq!(in_cycles(&imports(&chain)), []);
        let cycle = [("a", "use crate::b;"), ("b", "use crate::c;"), ("c", "use crate::b; use crate::d;"), ("d", "")];
        assert_eq!(in_cycles(&imports(&cycle)), [(module("b"), module("c")), (module("c"), module("b"))]);
    }
}
