"""Measure how easily README and documentation read: words per sentence, and Flesch's reading ease (higher is easier).

    pip install readability
    python benchmarks/prose.py

Code, tables, headings and formulas are left out. Asked for are at most 18 words per sentence on average, and a reading
ease of at least 45 for README and tutorial.
"""

from __future__ import annotations

import re
from pathlib import Path

import readability

ROOT = Path(__file__).parents[1]
PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))


def sentences(text: str) -> list[str]:
    """Return the sentences of a page in Markdown."""
    text = re.sub(r"```.*?```|\$\$.*?\$\$|<!--.*?-->", " ", text, flags=re.DOTALL)
    text = re.sub(r"^\s*(\||#|-{3,}|!\[).*$", "", text, flags=re.MULTILINE)
    text = re.sub(r"^\s*(?:[-*]|\d+\.)\s+", "\n\n", text, flags=re.MULTILINE)
    text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", text)
    text = re.sub(r"`[^`]*`|\$[^$]*\$", "x", text).replace("*", "")
    parts = re.split(r"(?<=[.!?:;])\s+|\n\s*\n", text)
    return [" ".join(part.split()) for part in parts if len(part.split()) > 2]


def main() -> None:
    """Print one line per page."""
    print(f"{'page':26s} {'words':>6s} {'per sentence':>13s} {'reading ease':>13s}")
    for path in PAGES:
        text = path.read_text(encoding="utf-8")
        prose = sentences(text)
        measured = readability.getmeasures(prose, lang="en")
        ease = measured["readability grades"]["FleschReadingEase"]
        length = sum(len(sentence.split()) for sentence in prose) / len(prose)
        print(f"{path.name:26s} {len(text.split()):6d} {length:13.1f} {ease:13.0f}")


if __name__ == "__main__":
    main()
