"""Names from recordings as they stand in generated text: comments, Markdown, XML, identifiers of C."""

from __future__ import annotations

import re
from collections.abc import Iterable

from ..core import ConfigError

_ALLOWED = frozenset(" _-.,:;+()[]%/^=@°·²³")  # beside letters and digits of any script
_C_WORDS = re.compile(
    "auto|break|case|char|const|continue|default|do|double|else|enum|extern|float|for|goto|if|inline|int|long|register|"
    "restrict|return|short|signed|sizeof|static|struct|switch|typedef|union|unsigned|void|volatile|while|main"
)


def plain(text: object) -> str:
    """Return a text of which nothing is more than text in C, CMake, Markdown and XML.

    Letters, digits, blanks and ``_-.,:;+()[]%/^=@°·²³`` stay, ``*`` becomes ``·``, anything else ``_``: so no comment
    ends, no line is continued, no trigraph, quote, tag or change of the writing direction is left.

    Examples
    --------
    >>> from kros.export.text import plain
    >>> plain("N*m"), plain("x */ system(0) /*")
    ('N·m', 'x ·/ system(0) /·')
    """
    shown = str(text)[:80].replace("*", "·")
    return "".join(c if c.isalnum() or c in _ALLOWED else "_" for c in shown) or "_"


def plain_names(names: Iterable[str]) -> list[str]:
    """Return names as texts, which have to stay apart.

    Raises
    ------
    ConfigError
        When two names are the same text.
    """
    names = list(names)
    shown = [plain(name) for name in names]
    if len(set(shown)) < len(names):
        raise ConfigError(
            f"Export: the names {', '.join(map(repr, names))} cannot be told apart in generated code; rename channels "
            "by letters and digits."
        )
    return shown


def require_identifier(name: str, what: str = "name") -> str:
    """Return a name that is a C identifier of ASCII letters, digits and underscores, and no word of the language.

    Raises
    ------
    ConfigError
        When it is none.
    """
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]{0,40}", name, flags=re.ASCII) or _C_WORDS.fullmatch(name):
        raise ConfigError(
            f"Export to C: the {what} {name!r} should be a C identifier of letters, digits and underscores that "
            "begins with a letter, and no word of C."
        )
    return name
