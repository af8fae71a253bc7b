//! `docs/design/layout.md` shows the layout of messages as they are; a change to it needs a new `LAYOUT_VERSION`.

use std::fmt::Write;
use std::mem::offset_of;
use std::path::Path;

use endless_gym_core::batch::{BLOCK_BYTES, LAYOUT_VERSION, Layout, SectionTable, action_layout};
use endless_gym_core::pool::{Pool, PoolConfig, Threads};
use endless_gym_memory_gym::memory_gym;

use super::{RequestHeader, RequestKind, ResponseHeader};

/// A header as a C structure; the sizes of its fields follow from their offsets.
macro_rules! header {
    ($text:ident, $header:ident: $($field:ident)+) => {
        let fields = [$((stringify!($field), offset_of!($header, $field))),+];
        let ends = fields.iter().skip(1).map(|(_, offset)| *offset).chain([size_of::<$header>()]);
        writeln!($text, "struct {} {{ // {} bytes", stringify!($header), size_of::<$header>()).unwrap();
        for ((name, offset), end) in fields.iter().zip(ends) {
            writeln!($text, "    uint{} {name}; // at {offset}", 8 * (end - offset)).unwrap();
        }
        $text += "};\n\n";
    };
}

/// The sections of a batch or of the payload of a request, as a C structure.
fn sections<S: SectionTable>(text: &mut String, name: &str, layout: &Layout<S>) {
    writeln!(text, "struct {name} {{ // {} blocks of {BLOCK_BYTES} bytes", layout.blocks()).unwrap();
    for section in layout.sections() {
        let shape: String = section.shape().iter().map(|size| format!("[{size}]")).collect();
        let rows = layout.num_envs();
        writeln!(text, "    {} {}[{rows}]{shape}; // at {}", section.dtype(), section.name(), section.offset())
            .unwrap();
    }
    *text += "};\n\n";
}

#[test]
fn the_documentation_shows_the_layout() {
    let mut text = format!("// Layout version {LAYOUT_VERSION}\n\n");
    header!(text, RequestHeader: layout_version kind incarnation trainer request seed env bytes process held);
    let kinds = (1..).map_while(RequestKind::from_code).map(|kind| format!("{kind:?} = {}", kind.code()));
    let kinds: Vec<_> = kinds.collect();
    writeln!(text, "enum kind {{ {} }};\n", kinds.join(", ")).unwrap();
    header!(text, ResponseHeader: layout_version group incarnation step trainer request bytes status padding);
    let config = PoolConfig::new("MortarMayhem-Grid-v0", 4).features(true);
    let pool = Pool::new(memory_gym(), &config, &Threads::new(1).unwrap()).unwrap();
    sections(&mut text, "Batch", pool.layout());
    sections(&mut text, "Request", &action_layout(&pool.spec().action_space, 4).unwrap());

    let page = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/design/layout.md");
    let page = std::fs::read_to_string(page).unwrap();
    assert!(
        page.contains(text.trim_end()),
        "the layout differs from docs/design/layout.md: raise LAYOUT_VERSION, and change the page to\n{text}"
    );
}
