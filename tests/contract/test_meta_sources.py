"""House rules that hold for every source file, read from its syntax tree."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

SRC = Path(__file__).parents[2] / "src"
SOURCES = sorted(SRC.rglob("*.py"))
MODULES_THAT_PICKLE = {"cloudpickle", "dill", "joblib", "marshal", "pickle", "shelve"}
# `sympify` and `parse_expr` evaluate their text.
CALLS_REFUSED = {"eval", "exec", "parse_expr", "print", "sympify"}

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
    return missing + [name for name, node in public_definitions(tree) if not ast.get_docstring(node) and not is_overload(node)]


def is_overload(node: Definition) -> bool:
    return any(isinstance(d, ast.Name) and d.id == "overload" for d in node.decorator_list)


def parameters(node: Definition) -> list[str]:
    """Parameters of a function, or fields of a class."""
    if isinstance(node, ast.ClassDef):
        noted = [s for s in node.body if isinstance(s, ast.AnnAssign) and isinstance(s.target, ast.Name)]
        names = [s.target.id for s in noted if isinstance(s.target, ast.Name) and "ClassVar" not in ast.unparse(s.annotation)]
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


def refused(tree: ast.Module) -> list[str]:
    """Imports that pickle, and calls that evaluate text or print."""
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found += [a.name for a in node.names if a.name.split(".")[0] in MODULES_THAT_PICKLE]
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and (node.module or "").split(".")[0] in MODULES_THAT_PICKLE:
            found.append(node.module or "")
        elif isinstance(node, ast.Call):
            name = node.func.id if isinstance(node.func, ast.Name) else getattr(node.func, "attr", "")
            plain = isinstance(node.func, ast.Name) or name in ("parse_expr", "sympify")
            found += [name] if plain and name in CALLS_REFUSED else []
            found += [
                k.arg
                for k in node.keywords
                if k.arg == "allow_pickle" and not (isinstance(k.value, ast.Constant) and k.value.value is False)
            ]
    return found


@pytest.fixture(params=SOURCES, ids=[str(p.relative_to(SRC)) for p in SOURCES])
def tree(request: pytest.FixtureRequest) -> ast.Module:
    return ast.parse(request.param.read_text(encoding="utf-8"))


def test_everything_public_has_a_docstring(tree: ast.Module) -> None:
    assert undocumented(tree) == []


def test_parameters_are_documented_as_they_are(tree: ast.Module) -> None:
    assert wrongly_documented(tree) == []


def test_nothing_is_pickled_evaluated_or_printed(tree: ast.Module) -> None:
    assert refused(tree) == []


def test_missing_docstrings_are_found() -> None:
    source = "class A:\n    def b(self): ...\n    def _c(self): ...\ndef d(): 'Documented.'\n"
    assert undocumented(ast.parse(source)) == ["module", "A", "A.b"]


def test_wrong_parameters_are_found() -> None:
    section = "Parameters\n    ----------\n    a, b : int\n        Any.\n    d\n        Gone.\n\n    Returns\n    -------\n    int\n"
    docstring = f"    '''Add.\n\n    {section}    '''\n"
    assert wrongly_documented(ast.parse("def add(a, b, *c):\n" + docstring)) == ["add(c)", "add(d)"]
    assert wrongly_documented(ast.parse("class Add:\n" + docstring + "    a: int\n    b: int = 0\n    d: int = 0\n")) == []


@pytest.mark.parametrize(
    "source",
    [
        "import pickle",
        "from joblib import dump",
        "def f():\n    import numpy, cloudpickle.x",
        "print('x')",
        "eval('1')",
        "import sympy\nsympy.sympify('x')",
        "np.load(f, allow_pickle=True)",
    ],
)
def test_refused_code_is_found(source: str) -> None:
    assert len(refused(ast.parse(source))) == 1


def test_what_only_looks_like_it_is_let_through() -> None:
    assert refused(ast.parse("console.print('x')\nnp.load(f, allow_pickle=False)\nfrom .pickle_free import save\n")) == []
