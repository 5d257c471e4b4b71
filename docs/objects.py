"""Sphinx extension: one page for every public object in `api/`, tables of them by package, and links to them where pages name them in code."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from types import ModuleType

from docutils import nodes
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx

import kros

DOCS = Path(__file__).parent
COMMENT = "<!-- objects -->"


@cache
def packages() -> tuple[ModuleType, ...]:
    """Return the packages of kros that list names, in alphabetical order."""
    public = (
        m.name
        for m in pkgutil.walk_packages(kros.__path__, "kros.")
        if m.ispkg and m.name.split(".")[1] in kros.__all__
    )
    return tuple(package for package in map(importlib.import_module, sorted(public)) if hasattr(package, "__all__"))


def members(package: ModuleType) -> list[str]:
    """Return the full names of a package's public objects, without the packages in it."""
    return [
        f"{package.__name__}.{name}" for name in package.__all__ if not isinstance(getattr(package, name), ModuleType)
    ]


@cache
def names() -> tuple[str, ...]:
    """Return the full names of all public objects."""
    return tuple(name for package in packages() for name in members(package))


def get(name: str) -> object:
    """Return an object by its full name; a module of the same name (`kros.data.prepare`) is another."""
    package, _, last = name.rpartition(".")
    target: object = getattr(importlib.import_module(package), last)
    return target


def summary(target: object) -> str:
    """Return the first sentence of a docstring, for a cell of a table in Markdown."""
    first = " ".join((inspect.getdoc(target) or "").split("\n\n")[0].split()).replace("``", "`").replace("|", "\\|")
    return re.split(r"(?<=[^.]\.)\s+(?=[A-Z])", first)[0]


def title(text: str, line: str = "=") -> str:
    """Return a heading in reStructuredText."""
    return f"{text}\n{line * len(text)}\n"


@cache
def named() -> dict[str, list[str]]:
    """Return the pages that name an object in code, by its full name."""
    places: dict[str, list[str]] = {}
    for path in sorted({*DOCS.glob("*.md")} - {DOCS / "api.md"}):
        for name in sorted(set(re.findall(r"`(kros(?:\.\w+)+)", path.read_text(encoding="utf-8")))):
            places.setdefault(name, []).append(path.stem)
    return places


def object_page(name: str) -> str:
    """Return the page of one object: signature, docstring and example, then the pages that name it.

    It is in no table of contents: the sidebar of every page would be longer by all objects, and the build three times as long.
    """
    target = get(name)
    kind = "function"
    if isinstance(target, type):
        kind = "exception" if issubclass(target, BaseException) else "class"
    places = named().get(name, [])
    links = f"\nNamed in: {', '.join(f':doc:`/{place}`' for place in places)}.\n" if places else ""
    package, _, last = name.rpartition(".")
    return f":orphan:\n\n{title(name)}\nOf :doc:`{package}`.\n\n.. currentmodule:: {package}\n\n.. auto{kind}:: {last}\n{links}"


def package_page(package: ModuleType) -> str:
    """Return the page of one package: its docstring, and a table of its objects."""
    name = package.__name__
    inner = [other.__name__ for other in packages() if other.__name__.rpartition(".")[0] == name]
    rows = "".join(f"   * - :py:obj:`~{full}`\n     - {rst(summary(get(full)))}\n" for full in members(package))
    table = f"\n{title('Objects', '-')}\n.. list-table::\n   :widths: 30 70\n\n{rows}"
    tree = "\n.. toctree::\n   :hidden:\n\n" + "".join(f"   {other}\n" for other in inner)
    return f"{title(name)}\n.. automodule:: {name}\n   :no-members:\n{table}{tree}"


def rst(text: str) -> str:
    """Return a line of a docstring as a cell of a table; single backticks are code, a star is a star."""
    return text.replace("\\|", "|").replace("*", "\\*")


def pages() -> Iterator[tuple[str, str]]:
    """Yield every page by its name."""
    for package in packages():
        yield package.__name__, package_page(package)
    for name in names():
        yield name, object_page(name)


def tables() -> str:
    """Return, for every package, what it is and a table of its objects."""
    parts = []
    for package in packages():
        rows = "\n".join(f"| {{py:obj}}`~{name}` | {summary(get(name))} |" for name in members(package))
        parts.append(f"## {package.__name__}\n\n{summary(package)}\n\n| name | is |\n|---|---|\n{rows}\n")
    top = [package.__name__ for package in packages() if package.__name__.count(".") == 1]
    listed = "\n".join(f"{name} <api/{name}>" for name in top)
    return "\n".join([*parts, f"```{{toctree}}\n:hidden:\n\n{listed}\n```\n"])


def write(folder: Path) -> None:
    """Write the pages that changed, and delete those of objects that are no more."""
    folder.mkdir(exist_ok=True)
    texts = dict(pages())
    for path in folder.glob("*.rst"):
        if path.stem not in texts:
            path.unlink()
    for name, text in texts.items():
        path = folder / f"{name}.rst"
        if not path.is_file() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


def link(_app: Sphinx, tree: nodes.document) -> None:
    """Make links of objects' full names where a page has them in code."""
    for node in list(tree.findall(nodes.literal)):
        if node.astext() in names() and not isinstance(node.parent, (nodes.reference, pending_xref)):
            target = pending_xref(refdomain="py", reftype="obj", reftarget=node.astext(), refexplicit=True, refdoc="")
            node.replace_self(target)
            target += node


def setup(app: Sphinx) -> dict[str, bool]:
    """Have Sphinx find the pages, fill the tables and link names."""

    def fill(_app: Sphinx, _name: str, source: list[str]) -> None:
        source[0] = source[0].replace(COMMENT, tables()) if COMMENT in source[0] else source[0]

    app.connect("builder-inited", lambda app: write(Path(app.srcdir) / "api"))
    app.connect("source-read", fill)
    app.connect("doctree-read", link)
    return {"parallel_read_safe": True}
