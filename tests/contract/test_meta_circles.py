"""No modules of kros import one another in a circle, imports inside functions and for types alone included."""

from __future__ import annotations

import grimp
import pytest


def circles(arrows: dict[str, set[str]]) -> list[list[str]]:
    """Return the strongly connected components of more than one module (Tarjan's algorithm)."""
    number: dict[str, int] = {}
    lowest: dict[str, int] = {}
    stack: list[str] = []
    found = []

    def visit(module: str) -> None:
        number[module] = lowest[module] = len(number)
        stack.append(module)
        for other in arrows[module]:
            if other not in number:
                visit(other)
            if other in stack:
                lowest[module] = min(lowest[module], lowest[other])
        if lowest[module] == number[module]:
            component = stack[stack.index(module) :]
            del stack[stack.index(module) :]
            if len(component) > 1:
                found.append(sorted(component))

    for module in arrows:
        if module not in number:
            visit(module)
    return found


@pytest.mark.parametrize(
    ("arrows", "expected"),
    [({"a": {"b"}, "b": {"c"}, "c": set()}, []), ({"a": {"b"}, "b": {"c"}, "c": {"a"}}, [["a", "b", "c"]])],
)
def test_circles_are_found(arrows: dict[str, set[str]], expected: list[list[str]]) -> None:
    assert circles(arrows) == expected


def test_no_modules_import_one_another_in_a_circle() -> None:
    graph = grimp.build_graph("kros")
    assert len(graph.modules) > 100
    arrows = {module: set(graph.find_modules_directly_imported_by(module)) for module in sorted(graph.modules)}
    assert circles(arrows) == []
