//! The documentation: MkDocs' pages and rustdoc's reference as one site under the target directory.

use std::fs;
use std::process::Command;

use crate::shell::{cargo, describe, output, run, target, workspace};
use crate::{python, web};

/// Checks the generated parts of the pages, or writes them, and builds the site. Warnings, links to missing pages or
/// anchors, and error messages without help are errors.
pub fn build(write: bool) -> Result<(), String> {
    let folder = python::sync("docs", "bindings/python", &["--group", "docs"])?;
    let mut generate = Command::new(folder.join("bin/python"));
    generate.arg("docs/generate.py").args((!write).then_some("--check")).current_dir(workspace());
    let list = target()?.join("environments.json");
    let mut environments = cargo(&["run", "--quiet", "--locked", "--bin", "endless", "--", "list", "--json"]);
    fs::write(&list, output(&mut environments)?).map_err(describe(&list))?;
    run(generate.stdin(fs::File::open(&list).map_err(describe(&list))?))?;

    let site = target()?.join("site");
    let mut mkdocs = Command::new(folder.join("bin/mkdocs"));
    // Without `--quiet`, which would keep warnings from being errors.
    mkdocs.args(["build", "--strict", "--site-dir"]).arg(&site).current_dir(workspace());
    // Silences an announcement of Material for MkDocs.
    mkdocs.env("NO_MKDOCS_2_WARNING", "1");
    if web::Toolchain::find().is_some() {
        web::build()?;
        mkdocs.env("ENDLESS_DOCS_PAGE", web::folder()?);
    } else {
        println!("without the page; missing: {}", web::MISSING);
    }
    output(&mut mkdocs)?;
    run(cargo(&["doc", "--workspace", "--no-deps", "--locked", "--quiet"]).env("RUSTDOCFLAGS", "--deny warnings"))?;
    let copy = ["--recursive", "--no-target-directory"];
    run(Command::new("cp").args(copy).arg(target()?.join("doc")).arg(site.join("rust")))?;
    println!("{}", site.join("index.html").display());
    Ok(())
}
