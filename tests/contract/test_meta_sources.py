"""House rules that hold for every source file, read from its syntax tree."""

from __future__ import annotations

import ast
import re
from collections.abc import Callable, Iterator
from pathlib import Path

SRC = Path(__file__).parents[2] / "src"
TREES = {str(path.relative_to(SRC)): ast.parse(path.read_text(encoding="utf-8")) for path in sorted(SRC.rglob("*.py"))}

Definition = ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef


def public_definitions(tree: ast.Module | ast.ClassDef, prefix: str = "") -> Iterator[tuple[str, Definition]]:
    """Public classes and functions of a module, and the public methods of those classes."""
    for node in tree.body:
        if isinstance(node, Definition) and not node.name.startswith("_"):
            yield prefix + node.name, node
            if isinstance(node, ast.ClassDef):
                yield from public_definitions(node, f"{prefix}{node.name}.")


def undocumented(tree: ast.Module) -> list[str]:
    """Names without a docstring; ``module`` stands for the module itself."""
    missing = [] if ast.get_docstring(tree) else ["module"]
    return missing + [
        name for name, node in public_definitions(tree) if not ast.get_docstring(node) and not is_overload(node)
    ]


def is_overload(node: Definition) -> bool:
    return any(isinstance(d, ast.Name) and d.id == "overload" for d in node.decorator_list)


def parameters(node: Definition) -> list[str]:
    """Parameters of a function, or fields of a class."""
    if isinstance(node, ast.ClassDef):
        noted = [s for s in node.body if isinstance(s, ast.AnnAssign) and isinstance(s.target, ast.Name)]
        names = [
            s.target.id for s in noted if isinstance(s.target, ast.Name) and "ClassVar" not in ast.unparse(s.annotation)
        ]
        return [n for n in names if not n.startswith("_")]
    arguments = node.args
    named = [*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs]
    starred = [a for a in (arguments.vararg, arguments.kwarg) if a]
    return [a.arg for a in [*named, *starred] if a.arg not in ("self", "cls")]


def documented_parameters(docstring: str) -> list[str] | None:
    """Names in the docstring's section of parameters; None without such a section."""
    section = re.search(r"^Parameters\n-+\n(.*?)(?=^\w[^\n]*\n-{3,}\n|\Z)", docstring, flags=re.MULTILINE | re.DOTALL)
    if not section:
        return None
    heads = re.findall(r"^(\*{0,2}\w[^:\n]*?) *(?::.*)?$", section[1], flags=re.MULTILINE)
    return [name.strip().lstrip("*") for head in heads for name in head.split(",")]


def wrongly_documented(tree: ast.Module) -> list[str]:
    """Parameters that a section leaves out or invents, where there is a section."""
    wrong = []
    for name, node in public_definitions(tree):
        documented = documented_parameters(ast.get_docstring(node) or "")
        if documented is None or (isinstance(node, ast.ClassDef) and not parameters(node)):
            continue
        wrong += [f"{name}({parameter})" for parameter in sorted(set(documented) ^ set(parameters(node)))]
    return wrong


def complaints(check: Callable[[ast.Module], list[str]]) -> dict[str, list[str]]:
    """What a check says of each source file that is not as it should be."""
    return {name: wrong for name, tree in TREES.items() if (wrong := check(tree))}


def test_everything_public_has_a_docstring() -> None:
    assert complaints(undocumented) == {}


def test_parameters_are_documented_as_they_are() -> None:
    assert complaints(wrongly_documented) == {}


def test_wrong_parameters_are_found() -> None:
    section = "Parameters\n    ----------\n    a, b : int\n        Any.\n    d\n        Gone.\n\n    Returns\n    -------\n    int\n"
    docstring = f"    '''Add.\n\n    {section}    '''\n"
    assert wrongly_documented(ast.parse("def add(a, b, *c):\n" + docstring)) == ["add(c)", "add(d)"]
    assert (
        wrongly_documented(ast.parse("class Add:\n" + docstring + "    a: int\n    b: int = 0\n    d: int = 0\n")) == []
    )


def test_what_must_pass_calls_targets_that_exist() -> None:
    makefile, script = (Path(__file__).parents[2].joinpath(name).read_text() for name in ("Makefile", ".ci/run"))
    called = re.findall(r"^make (\w+)", script, re.M)
    assert called
    assert [name for name in called if not re.search(rf"^{name}:", makefile, re.M)] == []
