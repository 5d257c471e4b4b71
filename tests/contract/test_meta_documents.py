"""The examples in docstrings and documents run, the configurations in documents are valid, and pages keep their form and length."""

from __future__ import annotations

import doctest
import importlib
import pkgutil
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import typer

import kros
from kros.cli import app
from kros.core import ConfigError

ROOT = Path(__file__).parents[2]
DOCUMENTS = sorted([*(ROOT / "docs").glob("*.md"), *ROOT.glob("*.md"), *(ROOT / "examples").rglob("*.md")])
PAGES = sorted((ROOT / "docs").glob("*.md"))
MODULES = sorted(m.name for m in pkgutil.walk_packages(kros.__path__, "kros."))


def run_examples(tests: list[doctest.DocTest]) -> list[str]:
    """Reports of examples that do not give what they say."""
    report: list[str] = []
    runner = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS)
    for test in tests:
        runner.run(test, out=report.append)
    return report


def failures(module: ModuleType) -> list[str]:
    """Examples in a module's docstrings that fail."""
    return run_examples(doctest.DocTestFinder(exclude_empty=True).find(module))


def blocks(text: str, language: str) -> list[str]:
    """Fenced blocks of a document."""
    return re.findall(rf"^```{language}\n(.*?)^```$", text, flags=re.MULTILINE | re.DOTALL)


def unknown_names(text: str) -> list[str]:
    """Dotted names of kros in a document that stand for nothing."""
    missing = []
    for name in sorted(set(re.findall(r"`(kros(?:\.\w+)+)", text))):
        try:
            pkgutil.resolve_name(name)
        except (ImportError, AttributeError):
            missing.append(name)
    return missing


def check_configuration(text: str) -> None:
    """Read a CSV mapping, or a study, as kros reads it."""
    table = tomllib.loads(text)
    if "files" in table:
        from kros.data.readers.csv_folder import load_mapping

        _ = load_mapping(table).steps
    else:
        kros.study.validate_config({"data": {"source": "."}, **table}, ROOT)
        from kros.data.prepare import parse_steps

        parse_steps(table.get("data", {}).get("prepare", ()))


@pytest.mark.parametrize("name", MODULES)
def test_examples_run(name: str) -> None:
    assert failures(importlib.import_module(name)) == []


@pytest.mark.parametrize("path", DOCUMENTS, ids=[str(p.relative_to(ROOT)) for p in DOCUMENTS])
def test_examples_of_documents_run(path: Path) -> None:
    text = "\n".join(blocks(path.read_text(encoding="utf-8"), "python"))
    assert run_examples([doctest.DocTestParser().get_doctest(text, {}, path.name, str(path), 0)]) == []


def command(names: list[str]) -> Any:
    """The command that a line begins with; None if it does not exist."""
    command: Any = typer.main.get_command(app)
    for name in names:
        if not hasattr(command, "commands"):
            return command
        command = command.commands.get(name)
        if command is None:
            return None
    return command


def unknown_commands(text: str) -> list[str]:
    """Lines of consoles with a command or an option that kros does not have."""
    lines = re.findall(r"^\$ (?:\S*/)?kros (.*?)(?:\s+#.*)?$", "\n".join(blocks(text, "console")), flags=re.MULTILINE)
    unknown = []
    for line in lines:
        words = line.split(" && ")[0].split()
        called = command([word for word in words if not word.startswith("-")])
        options = {word.partition("=")[0] for word in words if word.startswith("--")} - {
            "--help",
            "--version",
            "--debug",
        }
        known = {option for parameter in called.params for option in parameter.opts} if called else set()
        if called is None or not options <= known:
            unknown.append(line)
    return unknown


def unknown_functions(text: str) -> set[str]:
    """Functions of C that a document calls and that are not generated."""
    header = (ROOT / "src/kros/export/c99/templates/observer.h.jinja").read_text(encoding="utf-8")
    declared = set(re.findall(r"\{\{ name \}\}_(\w+?)(?:\{\{ \w+ \}\})?\(", header))
    called = set(re.findall(r"\baxis_(\w+)\(", "\n".join(blocks(text, "c"))))
    return {name for name in called if name not in declared and name.rpartition("_")[0] + "_" not in declared}


def test_unknown_commands_are_found() -> None:
    text = "```console\n$ kros runs study.toml\n$ .venv/bin/kros run study.toml --set a.b=1  # why\n$ kros check a b --jsn\n```\n"
    assert unknown_commands(text) == ["runs study.toml", "check a b --jsn"]


def test_an_unknown_key_is_found() -> None:
    with pytest.raises(ConfigError, match="sorce"):
        check_configuration('[data]\nsorce = "here"\n')
    with pytest.raises(ConfigError, match="chanel"):
        check_configuration("files = '.*'\ntime = 't'\n[[chanel]]\n")


def test_page_of_reliability_is_that_of_the_results(monkeypatch: pytest.MonkeyPatch) -> None:
    """What the campaigns found is what the page says."""
    folder = ROOT / "benchmarks" / "reliability"
    monkeypatch.syspath_prepend(folder)
    page = importlib.import_module("page")
    assert (ROOT / "docs" / "reliability.md").read_text(encoding="utf-8") == page.render(), (
        "run benchmarks/reliability/page.py"
    )


def opening(text: str) -> str:
    """What stands before the first heading of a section."""
    return re.split(r"^## ", text, maxsplit=1, flags=re.MULTILINE)[0]


def without_question_or_example(text: str) -> list[str]:
    """What a page lacks: the reader's question, or an example, within its first forty lines."""
    first = "\n".join(text.splitlines()[:40])
    question = re.search(r"\*[^*]+\?\*", " ".join(opening(text).split()))
    example = re.search(r"^```(python|console|toml)$", first, flags=re.MULTILINE)
    return [what for what, there in (("question", question), ("example", example)) if not there]


@pytest.mark.parametrize("path", PAGES, ids=[path.name for path in PAGES])
def test_pages_begin_with_a_question_and_their_python_is_run(path: Path) -> None:
    """A block is a doctest, or the tutorial's, which `tests/e2e/test_tutorial.py` runs."""
    text = path.read_text(encoding="utf-8")
    assert without_question_or_example(text) == []
    assert path.name == "tutorial.md" or [b for b in blocks(text, "python") if not b.startswith(">>> ")] == []


def test_a_page_without_question_is_found() -> None:
    assert without_question_or_example("# A\n\nWhat?\n\n## B\n\n*Why?*\n") == ["question", "example"]


MOST_WORDS = {"README.md": 950, "docs/limits.md": 1200, "docs/*.md": 26_000}


@pytest.mark.parametrize("pattern", MOST_WORDS)
def test_documents_stay_short(pattern: str) -> None:
    assert sum(len(path.read_text(encoding="utf-8").split()) for path in ROOT.glob(pattern)) <= MOST_WORDS[pattern]


def test_the_glossary_has_at_most_forty_terms() -> None:
    rows = re.findall(r"^\| (?!-)", (ROOT / "docs" / "glossary.md").read_text(encoding="utf-8"), flags=re.MULTILINE)
    assert 20 < len(rows) - 1 <= 40


def test_every_page_is_in_the_contents() -> None:
    index = (ROOT / "docs" / "index.md").read_text(encoding="utf-8")
    listed = "\n".join(blocks(index, r"\{toctree\}")).split()
    assert sorted({path.stem for path in PAGES} - {"index"} - set(listed)) == []


def page_of_keys(monkeypatch: pytest.MonkeyPatch) -> str:
    """The page of keys as it is built."""
    monkeypatch.syspath_prepend(ROOT / "docs")
    return importlib.import_module("keys").fill((ROOT / "docs" / "keys.md").read_text(encoding="utf-8"))


def test_every_key_of_a_study_is_on_the_page_of_keys(monkeypatch: pytest.MonkeyPatch) -> None:
    page = page_of_keys(monkeypatch)
    schema = kros.study.StudyConfig.model_json_schema()
    tables = {
        name: schema["$defs"][text["$ref"].rsplit("/", 1)[1]]
        for name, text in schema["properties"].items()
        if "$ref" in text
    }
    assert len(tables) == 11
    for name, table in tables.items():
        section = page.split(f"### `[{name}]`\n")[1].split("\n### ")[0]
        rows = {
            row.split("`")[1]: [cell.strip() for cell in row.split(" | ")]
            for row in section.splitlines()
            if row.startswith("| `")
        }
        assert list(rows) == list(table["properties"])
        assert [key for key, cells in rows.items() if len(cells) != 4 or len(cells[3]) < 4] == [], (
            "says nothing: add a description"
        )


def test_every_key_of_a_mapping_says_something(monkeypatch: pytest.MonkeyPatch) -> None:
    lines = page_of_keys(monkeypatch).split("## A mapping")[1].split("## Preparation steps")[0].splitlines()
    rows = [row for row in lines if row.startswith("| `")]
    assert len(rows) == 28
    assert [row for row in rows if row.endswith("|  |")] == []


def pages_of_objects(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The extension that writes a page for every public object."""
    monkeypatch.syspath_prepend(ROOT / "docs")
    return importlib.import_module("objects")


def test_every_public_object_has_a_page_and_a_row(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    objects = pages_of_objects(monkeypatch)
    public = {f"{p.__name__}.{name}": getattr(p, name) for p in packages() for name in p.__all__}
    expected = {name for name, found in public.items() if not isinstance(found, ModuleType)}
    assert len(expected) > 100
    (tmp_path / "kros.core.gone.rst").touch()
    objects.write(tmp_path)
    assert {path.stem for path in tmp_path.iterdir()} == expected | {package.__name__ for package in packages()}
    rows = re.findall(r"^\| \{py:obj\}`~(\S+)` \| (.+) \|$", objects.tables(), flags=re.MULTILINE)
    assert {name for name, _ in rows} == expected
    assert [name for name, says in rows if not says.endswith(".") or not 10 < len(says) < 150] == []


def packages() -> Iterator[ModuleType]:
    """Public packages of kros that list names."""
    public = (
        m.name
        for m in pkgutil.walk_packages(kros.__path__, "kros.")
        if m.ispkg and m.name.split(".")[1] in kros.__all__
    )
    return (package for package in map(importlib.import_module, public) if hasattr(package, "__all__"))


def without_example(package: ModuleType) -> list[str]:
    """Names that a package lists and that show nobody how they are used; `test_examples_run` runs the examples of the others."""
    return [
        name
        for name in package.__all__
        if name != "__version__" and ">>> " not in (getattr(package, name).__doc__ or "")
    ]


@pytest.mark.parametrize("package", [kros, *packages()], ids=lambda package: package.__name__)
def test_every_public_object_has_an_example(package: ModuleType) -> None:
    assert without_example(package) == []
    assert ">>> " in (package.__doc__ or "") or package is kros


def formulas_of(text: str) -> list[str]:
    """Formulas in a document, in lines and between them."""
    prose = re.sub(r"^```.*?^```$|`[^`]*`", "", text, flags=re.MULTILINE | re.DOTALL)
    return [a or b for a, b in re.findall(r"\$\$(.+?)\$\$|\$([^$\n]+)\$", prose, flags=re.DOTALL)]


@pytest.mark.parametrize("path", DOCUMENTS, ids=[str(p.relative_to(ROOT)) for p in DOCUMENTS])
def test_formulas_become_mathml(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What the documentation's extension cannot convert would be missing in a browser."""
    monkeypatch.syspath_prepend(ROOT / "docs")
    mathml = importlib.import_module("mathml")
    for formula in formulas_of(path.read_text(encoding="utf-8")):
        assert mathml.tex2mathml(mathml.TAG.sub("", formula)).startswith("<math")


def slug(heading: str) -> str:
    """The anchor of a heading, as GitHub and MyST make it."""
    return re.sub(r"[^\w\- ]", "", re.sub(r"[`*]|\]\([^)]*\)", "", heading).lower()).replace(" ", "-")


def broken_links(path: Path, text: str) -> list[str]:
    """Links to files that are not there, and to headings that they do not have."""
    broken = []
    prose = re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL)
    for target, anchor in re.findall(r"\]\((?!\w+:)([^)#\s]*)#?([^)\s]*)\)", prose):
        to = path.parent / target if target else path
        headings = (
            re.findall(r"^#+ (.+)$", to.read_text(encoding="utf-8"), flags=re.MULTILINE)
            if to.suffix == ".md" and to.is_file()
            else []
        )
        if not to.exists() or (anchor and anchor not in map(slug, headings)):
            broken.append(f"{target}#{anchor}")
    return broken


@pytest.mark.parametrize("path", DOCUMENTS, ids=[str(p.relative_to(ROOT)) for p in DOCUMENTS])
def test_what_documents_name_exists(path: Path) -> None:
    """Keys, names, commands, functions in C and links; Sphinx looks at links of docs/ alone."""
    text = path.read_text(encoding="utf-8")
    for block in blocks(text, "toml"):
        check_configuration(block)
    assert unknown_names(text) == []
    assert unknown_commands(text) == []
    assert unknown_functions(text) == set()
    assert broken_links(path, text) == []


def test_broken_links_are_found() -> None:
    text = "[a](docs/data.md#preparation) [b](docs/date.md) [c](docs/data.md#preparations) [d](https://example.org) [e](#e)\n# E\n"
    assert broken_links(ROOT / "README.md", text) == ["docs/date.md#", "docs/data.md#preparations", "#e"]
