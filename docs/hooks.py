"""MkDocs hooks: pages from elsewhere in the repository, links to the page that plays, and a check for external files."""

import os
import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parent.parent

#: Documents elsewhere in the repository that are also pages of the site.
PAGES = {
    "design/comparison.md": "benches/comparison.md",
    "reference/changes.md": "CHANGELOG.md",
    "train/learning.md": "agents/benches/learning/README.md",
}

#: Scripts, pictures and style sheets from other hosts, which a page must not load.
EXTERNAL = re.compile(
    r"""<(?:script|img|iframe|source)\b[^>]*\ssrc=["']?(?:https?:)?//"""
    r"""|<link\b[^>]*rel=["']?(?:stylesheet|preconnect|icon)[^>]*href=["']?(?:https?:)?//"""
)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages from elsewhere in the repository, with their pictures."""
    for page, source in PAGES.items():
        files.append(File.generated(config, page, content=(ROOT / source).read_text()))
        for picture in (ROOT / source).parent.glob("*.png"):
            files.append(File.generated(config, f"{Path(page).parent}/{picture.name}", abs_src_path=str(picture)))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Point links that leave `docs/` to the site's copy of a page, or show their text; link the page that plays."""
    folder = (ROOT / "docs" / page.file.src_uri).parent
    here = Path(page.file.src_uri).parent
    if page.file.src_uri in PAGES:
        folder = (ROOT / PAGES[page.file.src_uri]).parent
    copies = {(ROOT / source).resolve(): name for name, source in PAGES.items()}

    def link(found: re.Match[str]) -> str:
        text, target, anchor = found.groups()
        file = (folder / target).resolve()
        if file in copies:
            return f"[{text}]({os.path.relpath(copies[file], here)}{anchor or ''})"
        if not file.exists() and target not in files.src_uris and (ROOT / "docs") not in file.parents:
            raise PluginError(f"{page.file.src_uri}: the link {target} leads nowhere")
        if (ROOT / "docs") in file.parents:
            return f"[{text}]({os.path.relpath(file, ROOT / 'docs' / here)}{anchor or ''})"
        return found[0] if file.suffix == ".png" else text

    def contents(found: re.Match[str]) -> str:
        return f"```{Path(found[1]).suffix[1:]}\n{(ROOT / found[1]).read_text()}```"

    # A link that forms a paragraph by itself is replaced by the file's contents.
    markdown = re.sub(r"^\[([\w/.-]+\.(?:rs|py|yaml|sh))\]\([^)]*\)$", contents, markdown, flags=re.M)
    markdown = re.sub(r"(?<!!)\[([^\]]*)\]\((?!https?:|#|mailto:)([^)#\s]+)(#[^)\s]*)?\)", link, markdown)
    if os.environ.get("ENDLESS_DOCS_PAGE"):
        markdown = markdown.replace("<!-- play -->", '<a href="play/index.html">Play in the browser</a>')
    return markdown


def on_post_build(config: MkDocsConfig) -> None:
    """Check that no page loads anything from other hosts."""
    for file in Path(config.site_dir).rglob("*.html"):
        if found := EXTERNAL.search(file.read_text()):
            raise PluginError(f"{file} loads something from elsewhere: {found[0]}")
