"""MkDocs hook: the parts of the documentation that follow from the sources.

Pages have comments, `<!-- generated: PART -->`, in the places where their parts are inserted. `cargo xtask docs` writes the
engine's table of environments and the messages of its errors as JSON into the folder that ENDLESS_DOCS_DATA names.
"""

import os
import re
from collections.abc import Iterable
from pathlib import Path

import messages
import tables
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from mkdocs.structure.nav import Navigation
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parent.parent
DATA = Path(os.environ["ENDLESS_DOCS_DATA"])
#: Whether the site has the page that plays the environments.
PAGE = bool(os.environ.get("ENDLESS_DOCS_PAGE"))
ENVIRONMENTS = tables.read(DATA / "environments.json")
MESSAGES = messages.Messages(ROOT, DATA / "errors.json")

#: Documents of the repository that are pages of the site, too.
PAGES = {
    "design/comparison.md": "benches/comparison.md",
    "reference/changes.md": "CHANGELOG.md",
    "train/learning.md": "agents/benches/learning/README.md",
}

#: What a page must not have: scripts, pictures and style sheets from other hosts.
EXTERNAL = re.compile(
    r"""<(?:script|img|iframe|source)\b[^>]*\ssrc=["']?(?:https?:)?//"""
    r"""|<link\b[^>]*rel=["']?(?:stylesheet|preconnect|icon)[^>]*href=["']?(?:https?:)?//"""
)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that are written elsewhere in the repository, with their pictures."""
    for page, source in PAGES.items():
        files.append(File.generated(config, page, content=(ROOT / source).read_text()))
        for picture in (ROOT / source).parent.glob("*.png"):
            files.append(File.generated(config, f"{Path(page).parent}/{picture.name}", abs_src_path=str(picture)))
    return files


def on_nav(nav: Navigation, config: MkDocsConfig, files: Files) -> None:
    """Check that every environment has a page, and every error a cure."""
    missing = [id for id in ENVIRONMENTS if files.get_file_from_path(f"environments/{id}.md") is None]
    if missing:
        raise PluginError(f"there is no page docs/environments/ID.md for {', '.join(missing)}")
    MESSAGES.check()


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Replace the comments by the parts that they name."""
    path = Path(page.file.src_uri)

    def part(found: re.Match[str]) -> str:
        kind, _, name = found[1].partition(" ")
        if kind == "environments":
            return tables.overview(spec for id, spec in ENVIRONMENTS.items() if name in id)
        if kind == "errors":
            return MESSAGES.of_type(name)
        if kind == "play":
            return play(ENVIRONMENTS, ".")
        if kind == "python":
            return MESSAGES.of_python()
        if path.stem not in ENVIRONMENTS:
            raise PluginError(f"docs/{path} describes no environment; there are {', '.join(ENVIRONMENTS)}")
        if kind == "picture":
            return picture(path.stem, files) + "\n\n" + play([path.stem], "..")
        return tables.PARTS[found[1]](ENVIRONMENTS[path.stem])

    return re.sub(r"<!-- generated: (.+?) -->", part, markdown)


def on_post_build(config: MkDocsConfig) -> None:
    """Check that no page loads anything from elsewhere when it is viewed."""
    for file in Path(config.site_dir).rglob("*.html"):
        if found := EXTERNAL.search(file.read_text()):
            raise PluginError(f"{file} loads something from elsewhere: {found[0]}")


def play(ids: Iterable[str], root: str) -> str:
    """Links to the page that plays environments, where it is part of the site; MkDocs does not know its files."""
    if not PAGE:
        return "This copy of the documentation was built without the page that plays environments in the browser."
    links = (f'<a href="{root}/play/index.html#env={id}&amp;seed=1">Play {id}</a>' for id in ids)
    return '<p class="play">' + "\n".join(links) + "</p>"


def picture(id: str, files: Files) -> str:
    """The animation of an environment, where `cargo xtask pictures` has made it."""
    name = f"images/environments/{id}.webp"
    if files.get_file_from_path(name) is None:
        return ""
    return f"![An episode of {id}](../{name}){{ .environment }}"
