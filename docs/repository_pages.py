"""Makes the repository's pages pages of the site, and its links hold there: a hook of MkDocs.

README.md and its neighbours lie where the repository's page shows them; the site shows the same files, without copies.
Every relative link is written for the repository. Here it becomes a link to the page of what it names, and a source
file or a folder that has none is given one. A line that asks a command for its help becomes that help.
"""

from __future__ import annotations

import posixpath
import re
from pathlib import Path
from typing import Any

import typer
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files, InclusionLevel
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[1]
PAGES = {
    "README.md": "index.md",
    "ARCHITECTURE.md": "architecture.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
    "fisheyerec/MODEL_CARD.md": "model-card.md",
}
LANGUAGES = {".py": "python", ".cpp": "cpp", ".h": "cpp", ".json": "json", ".txt": "text"}
LINK = re.compile(r"(?<=\]\()(?P<path>[^()\s#:]+)(?=[)#])")
HELP = re.compile(r"^`fisheyerec (?P<command>\w+) --help`$", re.MULTILINE)

uris: dict[Path, str] = {}
"""What the site has of the repository: path -> where in the site."""


def on_config(config: MkDocsConfig) -> None:
    """Put all pages of a folder where the navigation names the folder."""

    def filled(entry: Any) -> Any:
        if isinstance(entry, list):
            return [filled(e) for e in entry]
        if isinstance(entry, dict):
            return {title: filled(e) for title, e in entry.items()}
        if not entry.endswith("/"):
            return entry
        return [entry + page.name for page in sorted(Path(config.docs_dir, entry).glob("*.md"))]

    config.nav = filled(config.nav)


def on_files(files: Files, config: MkDocsConfig) -> None:
    """Add the pages of the root, and of the sources that are linked."""
    for source, uri in PAGES.items():
        files.append(File.generated(config, uri, abs_src_path=str(ROOT / source)))
    uris.clear()
    uris.update({Path(f.abs_src_path): f.src_uri for f in files if f.abs_src_path})
    for page in [f for f in files.documentation_pages() if f.abs_src_path]:
        for link in LINK.finditer(page.content_string):
            add_source(_target(Path(page.abs_src_path), link["path"]), files, config)


def add_source(path: Path, files: Files, config: MkDocsConfig) -> None:
    """Give a page to a source file, or to a folder and the sources in it, that has none."""
    if path in uris or not path.is_relative_to(ROOT) or not (path.is_dir() or path.suffix in LANGUAGES):
        return
    name = path.relative_to(ROOT).as_posix()
    uris[path] = f"source/{name}.md"
    if path.is_dir():
        inside = sorted(p for p in path.iterdir() if p.suffix in LANGUAGES or p in uris)
        for entry in inside:
            add_source(entry, files, config)
        lines = [f"- [{p.name}]({posixpath.relpath(uris[p], posixpath.dirname(uris[path]))})" for p in inside]
        content = "\n".join([f"# {name}", "", *lines])
    else:
        content = f"# {name}\n\n````{LANGUAGES[path.suffix]}\n{path.read_text(encoding='utf-8')}\n````\n"
    files.append(File.generated(config, uris[path], content=content, inclusion=InclusionLevel.NOT_IN_NAV))


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Turn links within the repository into links within the site, and lines that ask for help into help.

    What leads nowhere is left for MkDocs to report.
    """
    if page.file.abs_src_path is None:
        return markdown
    here, folder = Path(page.file.abs_src_path), posixpath.dirname(page.file.src_uri)

    def moved(link: re.Match[str]) -> str:
        uri = uris.get(_target(here, link["path"]))
        return link["path"] if uri is None else posixpath.relpath(uri, folder or ".")

    return HELP.sub(lambda line: help_of(line["command"]), LINK.sub(moved, markdown))


def _target(here: Path, link: str) -> Path:
    return (here.parent / link).resolve()


def help_of(name: str) -> str:
    """A command's own help, its options as a table."""
    from fisheyerec.cli import app

    group: Any = typer.main.get_command(app)
    command = group.commands[name]
    lines = [command.help, "", "| option | what it does |", "|---|---|"]
    for parameter in command.params:
        names = parameter.metavar or parameter.name.upper()
        if parameter.param_type_name == "option":
            names = ", ".join([*parameter.opts, *parameter.secondary_opts])
        lines.append(f"| `{names}` | {parameter.help or ''}{_default(parameter)} |")
    return "\n".join(lines)


def _default(parameter: Any) -> str:
    if parameter.required:
        return " **Required.**"
    if parameter.default in (None, False, True, ()):
        return ""
    return f" `{parameter.default}` if left out."
