"""Sphinx extension: formulas as MathML, written into the page when it is built, so that no browser needs a network or a script to show them.

The converter is that of docutils; what it cannot convert is a warning, and `make docs` fails.
"""

from __future__ import annotations

import re

from docutils import nodes
from docutils.utils.math import MathError
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.application import Sphinx
from sphinx.util import logging
from sphinx.writers.html5 import HTML5Translator

log = logging.getLogger(__name__)
TAG = re.compile(r"\\tag\{([^}]*)\}")
# An accented letter is one symbol: without a group of its own the converter writes its index under it.
ACCENT = re.compile(r"\\(hat|bar|tilde|dot|ddot|vec)\s*(\{[^{}]*\}|\\[a-zA-Z]+|[a-zA-Z])")


def mathml(node: nodes.Node, formula: str, *, block: bool = False) -> str:
    """Return a formula in LaTeX as MathML; a warning, and nothing, where it cannot be converted."""
    try:
        return str(tex2mathml(ACCENT.sub(r"{\\\1 \2{}}", formula), as_block=block))
    except MathError as error:
        log.warning("formula %r: %s", formula, error, location=node)
        return ""


def visit_math(self: HTML5Translator, node: nodes.math) -> None:
    """Write a formula in a line."""
    self.body.append(mathml(node, node.astext()))
    raise nodes.SkipNode


def visit_block(self: HTML5Translator, node: nodes.math_block) -> None:
    """Write a formula of its own, and the number that a tag gives it."""
    formula = node.astext()
    number = "".join(f'<span class="eqno">({text})</span>' for text in TAG.findall(formula))
    self.body.append(
        f"{self.starttag(node, 'div', CLASS='math')}{number}{mathml(node, TAG.sub('', formula), block=True)}</div>\n"
    )
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict[str, bool]:
    """Make it a way in which formulas are shown, `html_math_renderer` chooses it."""
    app.add_html_math_renderer("mathml", (visit_math, None), (visit_block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
