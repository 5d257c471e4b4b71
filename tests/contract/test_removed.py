"""What kros no longer has is refused with the sentence of the changelog that says what to use instead."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

import pytest

import kros
from kros.core import ConfigError
from kros.core.removed import REMOVED, instead_of

CHANGES = (Path(__file__).parents[2] / "CHANGELOG.md").read_text(encoding="utf-8")
PLACES = [(sentence, place) for sentence, places in REMOVED for place in places.split()]


@pytest.mark.parametrize("sentence", [sentence for sentence, _ in REMOVED])
def test_the_changelog_has_the_sentence(sentence: str) -> None:
    assert sentence in re.sub(r"\s+", " ", CHANGES)


@pytest.mark.parametrize(("sentence", "place"), PLACES, ids=[place for _, place in PLACES])
def test_a_removed_name_is_refused_with_its_sentence(sentence: str, place: str) -> None:
    package, _, name = place.rpartition(".")
    if package.startswith("kros"):
        with pytest.raises(AttributeError, match=re.escape(sentence)):
            getattr(__import__(package, fromlist=[name]), name)
    else:
        with pytest.raises(ConfigError, match=re.escape(sentence)):
            kros.study.validate_config(study_with(place), Path())


def study_with(place: str) -> dict[str, Any]:
    """A study that sets a key, in a list of values where it is one."""
    key, _, value = place.partition("=")
    *section, name = key.split(".")
    listed = name in ("methods", "baselines")
    text = f"{name} = {[value] if listed else value!r}\n"
    return tomllib.loads('data.source = "here"\n' + (f"[{section[0]}]\n{text}" if section else text))


def test_what_was_never_there_has_no_sentence() -> None:
    assert instead_of("kros.synthesis.h3") == instead_of("synthesis.sett") == ""
