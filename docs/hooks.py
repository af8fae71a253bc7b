"""MkDocs hooks: pages from elsewhere, messages of errors, the page that plays and its colours, and a check for external files."""

import html
import os
import re
import shutil
from pathlib import Path

import generate
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parent.parent

#: Documents elsewhere in the repository that are also pages of the site.
PAGES = {
    "design/comparison.md": "benches/comparison.md",
    "reference/changes.md": "CHANGELOG.md",
    "train/leaderboard.md": "agents/benches/leaderboard/million/README.md",
    "train/ablations/index.md": "agents/benches/leaderboard/ablations/README.md",
    "train/hour.md": "agents/benches/hour/README.md",
}

#: The folder of the built page that plays; none if it is not part of the site.
PLAY = os.environ.get("ENDLESS_DOCS_PAGE")

#: The picture of links to the site.
PICTURE = "images/environments.webp"

#: Scripts, pictures and style sheets from other hosts, which a page must not load.
EXTERNAL = re.compile(
    r"""<(?:script|img|iframe|source)\b[^>]*\ssrc=["']?(?:https?:)?//"""
    r"""|<link\b[^>]*rel=["']?(?:stylesheet|preconnect|icon)[^>]*href=["']?(?:https?:)?//"""
)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages from elsewhere in the repository, with their pictures."""
    for page, source in PAGES.items():
        files.append(File.generated(config, page, content=(ROOT / source).read_text()))
        for picture in (ROOT / source).parent.glob("*.svg"):
            files.append(File.generated(config, f"{Path(page).parent}/{picture.name}", abs_src_path=str(picture)))
    files.append(File.generated(config, "palette.css", content=palette()))
    return files


def palette() -> str:
    """The colours of the page that plays, as variables of the theme's light and dark schemes."""
    style = (ROOT / "engine/page/files/style.css").read_text()
    colours = re.findall(r"(--[\w-]+): light-dark\((#\w+), (#\w+)\);", style)
    if not colours:
        raise PluginError(
            "style.css of the page that plays has no colours of the form `--name: light-dark(#fff, #000)`"
        )
    schemes = {
        "default": {name: light for name, light, _ in colours},
        "slate": {name: dark for name, _, dark in colours},
    }
    return "".join(
        f'[data-md-color-scheme="{scheme}"] {{ {" ".join(f"{name}: {colour};" for name, colour in values.items())} }}\n'
        for scheme, values in schemes.items()
    )


def preview(title: str, description: str, config: MkDocsConfig, root: str) -> str:
    """Tags for other sites that show a link to a page; `root` leads from the page to the site."""
    picture = (config.site_url or root) + PICTURE
    tags = {"title": title, "description": description, "type": "website", "image": picture}
    return "".join(f'<meta property="og:{name}" content="{html.escape(text)}">\n' for name, text in tags.items())


def on_post_page(output: str, page: Page, config: MkDocsConfig) -> str:
    """Add the preview."""
    title = config.site_name if page.is_homepage else f"{page.title} - {config.site_name}"
    root = "../" * page.url.count("/")
    return output.replace("</head>", preview(title, config.site_description or "", config, root) + "</head>", 1)


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
        if not file.exists():
            raise PluginError(f"{page.file.src_uri}: the link {target} leads nowhere")
        if (ROOT / "docs") in file.parents:
            return f"[{text}]({os.path.relpath(file, ROOT / 'docs' / here)}{anchor or ''})"
        return text

    def contents(found: re.Match[str]) -> str:
        return f"```{Path(found[1]).suffix[1:]}\n{(ROOT / found[1]).read_text()}```"

    markdown = generate.ERRORS.sub(lambda found: generate.errors(found[1]), markdown)
    # A link that forms a paragraph by itself is replaced by the file's contents.
    markdown = re.sub(r"^\[([\w/.-]+\.(?:rs|py|yaml|sh))\]\([^)]*\)$", contents, markdown, flags=re.M)
    markdown = re.sub(r"(?<!!)\[([^\]]*)\]\((?!https?:|#|mailto:)([^)#\s]+)(#[^)\s]*)?\)", link, markdown)
    if PLAY:
        markdown = markdown.replace("<!-- play -->", '<a href="play/index.html">Play in the browser</a>')
    return markdown


def on_post_build(config: MkDocsConfig) -> None:
    """Add the page that plays, with a link to the site, and check that no page loads anything from other hosts."""
    if PLAY:
        copy = Path(config.site_dir) / "play"
        shutil.copytree(PLAY, copy, dirs_exist_ok=True)
        text = (copy / "index.html").read_text()
        description = html.unescape(re.findall(r'name="description" content="([^"]*)"', text)[0])
        text = text.replace("</head>", preview("Endless Gym: play", description, config, "../") + "</head>", 1)
        linked, count = re.subn(
            r"<footer\b[^>]*>", r'\g<0>\n    <p><a href="../index.html">Documentation</a></p>', text
        )
        if count != 1:
            raise PluginError("the page that plays has no footer for the link to the documentation")
        (copy / "index.html").write_text(linked)
    for file in Path(config.site_dir).rglob("*.html"):
        if found := EXTERNAL.search(file.read_text()):
            raise PluginError(f"{file} loads something from elsewhere: {found[0]}")
