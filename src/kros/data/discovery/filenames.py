"""Unit, condition, episode and group from the names of files: a regular expression that says which part of a path is what.

A path is cut into words at ``/ _ - .`` and spaces. What is the same in all paths is text; what differs is told apart by the word that it begins
with or that stands before it (``run_3``), by what conditions are called, and else by its place: units before episodes.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from ..population import OUTLIERS

UNIT, CONDITION, EPISODE, GROUP = "unit", "condition", "episode", "group"
_WORDS = {
    UNIT: "act actuator gear unit drive motor cell battery pack machine device dev serial sn rig robot axis cylinder pump valve design "
    "joint sample specimen antrieb maschine "
    "geraet gerät pruefling prüfling einheit anlage moteur machine moteur variateur part id",
    EPISODE: "run rec recording episode ep trial test exp experiment take log trajectory traj measurement messung versuch lauf "
    "aufnahme essai mesure meas nr no",
    CONDITION: "condition cond load config mode case temp last bedingung zustand charge",
}
_STATES = """
load loaded noload unloaded idle empty full hot cold warm cool new worn dry wet on off last ohnelast leerlauf leer kalt heiss heiß
belastet unbelastet mitlast charge vide froid chaud forward reverse
"""
_CONDITIONS = set(_STATES.split())
_MEASURE = re.compile(
    r"^\d+(?:[.,]\d+)?(?:bar|mbar|psi|kpa|degc|°c|c|k|kg|g|n|nm|v|a|rpm|hz|mm|m|percent|pct|%)$", re.IGNORECASE
)
_DATE = re.compile(r"^(?:19|20)\d{6}(?:T?\d{4,6})?$")


@dataclass(frozen=True)
class FileNames:
    """What the paths of a folder say."""

    pattern: str  # regular expression with the groups `unit`, `condition`, `episode` and `group`, those that are there
    sure: bool  # whether words in the names said so; false where places alone decided
    other: str | None = None  # a second expression that fits the names as well: episodes of one unit in place of units


def infer_names(paths: Sequence[str]) -> FileNames:
    """Return the expression that tells the files of a folder apart."""
    stems, ending = _without_ending(paths)
    for cut in (_words(stems), _aligned(stems), _whole(stems)):
        if cut is None:
            continue
        rows, marks = cut
        roles, sure = _roles(rows, marks)
        pattern = _pattern(rows, marks, roles, ending)
        if _tells_apart(pattern, paths):
            numbered = (
                not sure
                and roles.count(UNIT) == 1
                and not {EPISODE, GROUP} & set(roles)
                and _counts([r[roles.index(UNIT)] for r in rows])
            )
            other = [EPISODE if r == UNIT else r for r in roles]
            return FileNames(pattern, sure, _pattern(rows, marks, other, ending) if numbered else None)
    return FileNames(rf"^(?P<unit>.+){ending}$", False)


def _counts(words: Sequence[str]) -> bool:
    """Tell whether words are one text with the numbers from 0 or 1 on, which may number units or episodes."""
    found = [re.fullmatch(r"(\D*)(\d+)", w) for w in words]
    if len(words) < 2 or not all(found) or len({m[1] for m in found if m}) > 1:
        return False
    numbers = sorted({int(m[2]) for m in found if m})
    return numbers[0] in (0, 1) and len(numbers) > 1 and numbers == list(range(numbers[0], numbers[0] + len(numbers)))


def _nested(columns: list[tuple[str, ...]], outer: int, inner: int) -> bool:
    """Tell whether the words at a place without numbers are labels of units: each unit at `inner`, a numbered word, has one, and a label has several."""
    values, labels = set(columns[inner]), set(columns[outer])
    pairs = set(zip(columns[outer], columns[inner], strict=True))
    return (
        len(labels) < len(values) == len(pairs)
        and all(re.search(r"\d", v) for v in values)
        and not any(re.search(r"\d", v) for v in labels)
    )


def _without_ending(paths: Sequence[str]) -> tuple[list[str], str]:
    found = [re.match(r"(.*?)((?:\.(?:csv|tsv|txt|dat|parquet))(?:\.gz)?)$", p, re.IGNORECASE) for p in paths]
    endings = sorted({m[2] for m in found if m})
    ending = re.escape(endings[0]) if len(endings) == 1 else f"(?:{'|'.join(re.escape(e) for e in endings)})"
    return [m[1] if m else p for m, p in zip(found, paths, strict=True)], ending


def _words(stems: Sequence[str]) -> tuple[list[list[str]], list[list[str]]] | None:
    """Cut into words; a number with a decimal point, or a version, stays whole."""
    for marks in (r"([/_\-. ]+)", r"([/_\- ]+)", r"([/_ ]+)"):
        parts = [re.split(marks, s) for s in stems]
        if len({len(p) for p in parts}) == 1 and not ("." in marks and any(re.search(r"\w\.\d", s) for s in stems)):
            return [p[::2] for p in parts], [p[1::2] for p in parts]
    return None


def _aligned(stems: Sequence[str]) -> tuple[list[list[str]], list[list[str]]] | None:
    """Cut into words, where some paths have more of them: what all begin with, and as many words at the end as all have."""
    parts = [re.split(r"([/_ ]+)", s) for s in stems]
    fewest = min(len(p) for p in parts)
    head = 0
    while head + 1 < fewest and len({tuple(p[head : head + 2]) for p in parts}) == 1:
        head += 2
    tail = fewest - head - 1
    cut = [[*p[:head], "".join(p[head : len(p) - tail]), *p[len(p) - tail :]] for p in parts]
    return ([c[::2] for c in cut], [c[1::2] for c in cut]) if tail > 0 else None


def _whole(stems: Sequence[str]) -> tuple[list[list[str]], list[list[str]]] | None:
    """Cut into folders and the first word of the name, where that is all that paths have in common."""
    parts = [re.split(r"(/)", s) for s in stems]
    if len({len(p) for p in parts}) != 1:
        return None
    last = [re.match(r"([^_\- ]+)([_\- ]+)(.+)$", p[-1]) for p in parts]
    if all(last):
        parts = [[*p[:-1], m[1], m[2], m[3]] for p, m in zip(parts, last, strict=True) if m]
    return [p[::2] for p in parts], [p[1::2] for p in parts]


def _roles(rows: list[list[str]], marks: list[list[str]]) -> tuple[list[str | None], bool]:
    """Say what every word is: text, or one of the groups."""
    columns = [tuple(row[i] for row in rows) for i in range(len(rows[0]))]
    varying = [i for i, c in enumerate(columns) if len(set(c)) > 1]
    roles: list[str | None] = [None] * len(columns)
    sure = True
    for i in varying:
        roles[i] = _told(columns, i)
    for i in range(len(columns) - 2):  # 2024-05-31
        if all(
            all(re.fullmatch(p, v) for v in columns[i + k])
            for k, p in enumerate((r"(?:19|20)\d\d", r"[01]\d", r"[0-3]\d\D*.*"))
        ):
            for k in set(varying) & {i, i + 1, i + 2}:
                roles[k] = EPISODE
    for i in varying:  # box1/box1_03
        if roles[i] is None and any(j < i and columns[i] == columns[j] for j in varying):
            roles[i] = "other"
    if UNIT not in roles:  # motor00_01 and motor00_02 are two episodes
        named = [
            i
            for i, c in enumerate(columns)
            if len(set(c)) == 1 and re.search(r"\d", c[0]) and _told(columns, i) == UNIT
        ]
        for i in named[:1] if varying else ():
            roles[i] = UNIT
    left = [i for i in varying if roles[i] is None]
    units = [i for i in varying if roles[i] is UNIT] or [i for i in left if len(set(columns[i])) < len(rows)]
    for i in left:
        if any(
            j > i and _nested(columns, i, j) for j in units
        ):  # good/act1, faulty/act3: two labels, and not two units
            roles[i] = GROUP
    left = [i for i in left if roles[i] is None]
    if left:
        sure = False
        if UNIT not in roles:  # what differs in every file is no machine, unless nothing else differs
            repeated = [i for i in left if len(set(columns[i])) < len(rows) or varying == [i]]
            if repeated:
                roles[repeated[0]] = UNIT
        for i in left:
            before = UNIT in roles[i + 1 :] and not any(roles[i + 1 : roles.index(UNIT, i + 1)])
            if roles[i] is None and before:
                numbered = all(re.search(r"\d", v) for v in columns[i])  # batch2/motor7: the batch is part of the name
                roles[i] = UNIT if numbered else CONDITION if CONDITION not in roles else EPISODE
            elif roles[i] is None:
                few = len(set(columns[i])) <= 4 and not any(v.isdigit() for v in columns[i])
                roles[i] = CONDITION if few and CONDITION not in roles and i != varying[-1] else EPISODE
    return _contiguous(roles, columns), sure


def _told(columns: list[tuple[str, ...]], i: int) -> str | None:
    """Return what words say about the words at one place."""
    values = {v.lower() for v in columns[i]}
    if OUTLIERS in values or "outlier" in values:
        return GROUP
    plain = {re.sub(r"[\d]+$", "", v) for v in values}
    if len(values & _CONDITIONS) >= max(1, len(values) - 1) or all(_MEASURE.match(v) for v in values):
        return CONDITION
    before = columns[i - 1][0].lower() if i and len(set(columns[i - 1])) == 1 else ""
    for role, words in _WORDS.items():
        known = words.split()
        if len(plain) == 1 and next(iter(plain)) in known and all(re.search(r"\d", v) for v in values):
            return role
        if re.sub(r"s$", "", before) in known:
            return role
    return EPISODE if all(_DATE.match(v) for v in columns[i]) else None


def _contiguous(roles: list[str | None], columns: list[tuple[str, ...]]) -> list[str | None]:
    """Keep of every role one stretch of places: what is between belongs to it where it is text, else the later places become episodes."""
    for role in (GROUP, UNIT, CONDITION, EPISODE):
        places = [i for i, r in enumerate(roles) if r == role]
        if len(places) < 2:
            continue
        between = roles[places[0] : places[-1] + 1]
        if all(r in (role, None) for r in between):
            roles[places[0] : places[-1] + 1] = [role] * len(between)
        elif role is EPISODE:
            for i in places[:-1]:
                if any(r not in (EPISODE, None) for r in roles[i : places[-1]]):
                    roles[i] = "other"
        else:
            for i in places[1:]:
                roles[i] = EPISODE
            return _contiguous(roles, columns)
    return roles


def quoted(text: str) -> str:
    """Return a text as an expression, without escapes that nobody needs."""
    return re.sub(r"\\([^\w\s.^$*+?{}\[\]|()\\])|\\ ", lambda m: m[1] or " ", re.escape(text))


def _pattern(rows: list[list[str]], marks: list[list[str]], roles: list[str | None], ending: str) -> str:
    """Write the expression."""
    text, i, n = "^", 0, len(roles)
    while i < n:
        end = i
        while roles[i] is not None and end + 1 < n and roles[end + 1] == roles[i]:
            end += 1
        values = {"".join(_joined(row, mark, i, end)) for row, mark in zip(rows, marks, strict=True)}
        if roles[i] is None:
            text += quoted(rows[0][i])
        elif roles[i] == "other":
            text += r"[^/]+?"
        else:
            text += f"(?P<{roles[i]}>{_class_of(values, end > i)})"
        if end + 1 < n:
            between = {mark[end] for mark in marks}
            text += quoted(between.pop()) if len(between) == 1 else r"[/_\-. ]+"
        i = end + 1
    return text + ending + "$"


def _joined(row: list[str], mark: list[str], start: int, end: int) -> list[str]:
    found = [row[start]]
    for i in range(start, end):
        found += [mark[i], row[i + 1]]
    return found


def _class_of(values: set[str], several: bool) -> str:
    if all(v.isdecimal() for v in values):
        return r"\d+"
    if several:
        return ".+"
    return r"[^/_]+" if not any("_" in v or "/" in v for v in values) else ".+?"


def _tells_apart(pattern: str, paths: Sequence[str]) -> bool:
    found = [re.search(pattern, p) for p in paths]
    if not all(found):
        return False
    keys = [tuple(m.groupdict().get(g) for g in (UNIT, CONDITION, EPISODE)) for m in found if m]
    return len(set(keys)) == len(paths)
