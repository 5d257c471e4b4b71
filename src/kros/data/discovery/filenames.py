"""Unit, condition, episode and group from the names of files, as a regular expression on their paths.

A path is cut into words. What differs between paths is told apart by the word that it begins with or that stands before
it (``run_3``), by what conditions are called, and else by its place: units before episodes.
"""

import re
from collections.abc import Iterable, Sequence
from itertools import chain, groupby
from typing import Any

from ...core import Names
from ..population import OUTLIERS
from ..readers.csv_folder import ENDINGS

UNIT, CONDITION, EPISODE, GROUP = "unit", "condition", "episode", "group"
_WORDS = {  # that a number follows
    UNIT: "act actuator gear unit drive motor cell battery pack machine device dev serial sn rig robot axis cylinder "
    "pump valve design joint sample specimen antrieb maschine geraet gerät pruefling prüfling einheit anlage moteur "
    "variateur part id",
    EPISODE: "run rec recording episode ep trial test exp experiment take log trajectory traj measurement messung day "
    "session versuch lauf aufnahme essai mesure meas nr no rep repetition repeat cyc cycle",
    CONDITION: "condition cond load config mode case temp last bedingung zustand charge",
}
_STATES = {
    CONDITION: "load loaded noload unloaded idle empty full hot cold warm cool new worn dry wet on off last ohnelast "
    "leerlauf leer kalt heiss heiß belastet unbelastet mitlast charge vide froid chaud forward reverse",
    EPISODE: "sine step chirp sweep prbs ramp random noise multisine sinus sprung rampe rauschen",
}
_ROLE_OF, _ROLE_OF_STATE = (
    {word: role for role, text in table.items() for word in text.split()} for table in (_WORDS, _STATES)
)
_MEASURE = re.compile(
    r"^\d+(?:[.,]\d+)?(?:bar|mbar|psi|kpa|degc|°c|c|k|kg|g|n|nm|v|a|rpm|hz|mm|m|percent|pct|%)$", re.IGNORECASE
)
_ENDING = re.compile(f"(?:{'|'.join(map(re.escape, ENDINGS))})$", re.IGNORECASE)
_DATE = re.compile(r"^(?:19|20)\d{6}(?:T?\d{4,6})?$")
_DATE_PARTS = (r"(?:19|20)\d\d", r"[01]\d", r"[0-3]\d\D*.*")  # 2024-05-31
Roles = list[str | None]
Cut = list[list[str]]  # words of every path, with what is between them


def infer_names(paths: Sequence[str]) -> tuple[str, str | None]:
    """Return the expression that tells files apart, and one for episodes of one unit where names do not say which."""
    stems = [_ENDING.sub("", p) for p in paths]
    endings = sorted({re.escape(p.removeprefix(stem)) for p, stem in zip(paths, stems, strict=True)})
    ending = endings[0] if len(endings) == 1 else f"(?:{'|'.join(endings)})"
    if cut := _cut(stems):
        columns = list(zip(*(p[::2] for p in cut), strict=True))
        roles, sure = _roles(columns, max((i for i, mark in enumerate(cut[0][1::2], 1) if "/" in mark), default=0))
        pattern = _pattern(cut, roles, ending)
        if _tells_apart(pattern, paths):
            alone = not sure and roles.count(UNIT) == 1 and not {EPISODE, GROUP} & set(roles)
            numbered = alone and _counts(columns[roles.index(UNIT)])
            episodes: Roles = [EPISODE if role == UNIT else role for role in roles]
            return pattern, _pattern(cut, episodes, ending) if numbered else None
    return rf"^(?P<unit>.+){ending}$", None


def _counts(words: Sequence[str]) -> bool:
    """Tell whether words are one text with the numbers from 0 or 1 on, which may number units or episodes."""
    alike = len({re.sub(r"\d+", "", w) for w in words}) == 1
    numbers = sorted({int(re.sub(r"\D", "", w) or -1) for w in words})
    return alike and len(numbers) > 1 and numbers[0] in (0, 1) and numbers[-1] - numbers[0] == len(numbers) - 1


def _cut(stems: Sequence[str]) -> Cut | None:
    """Cut into words, where some paths have more into as many at the end as all have, and what is before them.

    A number with a decimal point, or a version, stays whole.
    """
    whole = any(re.search(r"\w\.\d", s) for s in stems)
    for marks in (r"([/_\-. ]+)", r"([/_\- ]+)", r"([/_ ]+)")[whole:]:
        parts = [re.split(marks, s) for s in stems]
        if len(set(map(len, parts))) == 1:
            return parts
    tail = min(map(len, parts)) - 1
    return [["".join(p[:-tail]), *p[-tail:]] for p in parts] if tail > 0 else None


def _roles(columns: list[Names], folders: int) -> tuple[Roles, bool]:
    """Tell what every word is, the first ones of `folders`: text, or one of the groups; and whether words said so."""
    varying = [i for i, c in enumerate(columns) if len(set(c)) > 1]
    roles: Roles = [_by_words(columns, i) if i in varying else None for i in range(len(columns))]
    for i in range(len(columns) - 2):
        if all(re.fullmatch(p, v) for k, p in enumerate(_DATE_PARTS) for v in columns[i + k]):
            roles = [EPISODE if j in varying and i <= j <= i + 2 else role for j, role in enumerate(roles)]
    for i in varying:  # box1/box1_03
        if roles[i] is None and columns[i] in [columns[j] for j in varying if j < i]:
            roles[i] = "other"
    if UNIT not in roles and varying:  # motor00_01 and motor00_02 are two episodes
        same = [i for i, c in enumerate(columns) if i not in varying and re.search(r"\d", c[0])]
        named = next((i for i in same if _by_words(columns, i) == UNIT), None)
        roles = [UNIT if i == named else role for i, role in enumerate(roles)]
    left = [i for i in varying if roles[i] is None]
    if left:
        _by_place(columns, folders, varying, left, roles)
    return _contiguous(roles), not left


def _numbered(words: Iterable[str]) -> bool:
    return all(re.search(r"\d", word) for word in words)


def _by_words(columns: list[Names], i: int) -> str | None:
    """Return what words say about the words at one place."""
    values = {v.lower() for v in columns[i]}
    if values & {OUTLIERS, "outlier"}:
        return GROUP
    if all(_MEASURE.match(v) for v in values):
        return CONDITION
    plain = {re.sub(r"\d+$", "", v) for v in values}
    states = list(map(_ROLE_OF_STATE.get, plain))
    state = next((role for role in _STATES if states.count(role) >= max(1, len(plain) - 1)), None)
    before = columns[i - 1][0].lower() if i and len(set(columns[i - 1])) == 1 else ""
    numbered = plain.pop() if len(plain) == 1 and _numbered(values) else ""
    roles = {_ROLE_OF.get(numbered), _ROLE_OF.get(re.sub(r"s$", "", before))}
    role = state or next((role for role in _WORDS if role in roles), None)
    return role or (EPISODE if all(_DATE.match(v) for v in columns[i]) else None)


def _by_place(columns: list[Names], folders: int, varying: Sequence[int], left: Sequence[int], roles: Roles) -> None:
    """Set the roles that no word tells: of numbered words units before episodes, of labels groups and conditions."""
    numbered = [i for i in left if _numbered(columns[i])]
    if UNIT not in roles:  # what differs in every file is no machine, unless it is all that no word tells
        alone = EPISODE not in roles and len(left) == 1
        repeated = [i for i in left if alone or len(set(columns[i])) < len(columns[i])]
        counted = [i for i in repeated if i in numbered]
        above = [i for i in counted if i < folders and EPISODE in roles[i:]]  # hall1/crane1/run1: a folder of runs
        inner = [i for i in counted if EPISODE in roles or i < left[-1]]
        named = [i for i in inner if not all(map(str.isdecimal, columns[i]))]  # heavy_KX1041_1
        labelled = [j for i in set(repeated) - set(counted) for j in counted if _share(columns[i], columns[j]) == GROUP]
        for i in (above[-1:] or named or labelled or repeated)[:1]:
            roles[i] = UNIT
    units = list(zip(*(c for c, role in zip(columns, roles, strict=True) if role == UNIT), strict=True))
    for i in sorted((i for i in left if roles[i] is None), key=lambda i: (i not in numbered, -i)):
        share = None if i in numbered or not units else _share(columns[i], units)
        if share is None or (share == CONDITION and EPISODE not in roles):  # batch2/motor7: the batch is part of a name
            share = UNIT if next((roles[j] for j in varying if j > i), None) == UNIT else EPISODE
        roles[i] = share


def _share(labels: Sequence[Any], units: Sequence[Any]) -> str | None:
    """Return what labels of units are: groups of them, or conditions that two thirds have in common."""
    pairs, own, of = (len(set(words)) for words in (zip(labels, units, strict=True), labels, units))
    if pairs == of > own:
        return GROUP
    return CONDITION if pairs > max(own, of, 2 * own * of / 3) else None


def _contiguous(roles: Roles) -> Roles:
    """Keep of every role one stretch of places, with text between; others become episodes, or are not needed."""
    for role in (GROUP, UNIT, CONDITION, EPISODE):
        named = [i for i, r in enumerate(roles) if r is not None]
        runs = [list(run) for r, run in groupby(named, key=roles.__getitem__) if r == role]
        if runs:
            places = runs.pop(-1 if role is EPISODE else 0)
            roles[places[0] : places[-1] + 1] = [role] * (places[-1] + 1 - places[0])
        for i in chain(*runs):
            roles[i] = "other" if role is EPISODE else EPISODE
    return roles


def quoted(text: str) -> str:
    """Return a text as an expression, without escapes that are not needed."""
    return re.sub(r"\\([^\w\s.^$*+?{}\[\]|()\\])|\\ ", lambda m: m[1] or " ", re.escape(text))


def _pattern(cut: Cut, roles: Roles, ending: str) -> str:
    """Write the expression, with places of one role side by side in one group."""
    text = "^"
    for _, stretch in groupby(range(len(roles)), key=lambda i: roles[i] or i):
        first, *others = stretch
        last = others[-1] if others else first
        values = {"".join(p[2 * first : 2 * last + 1]) for p in cut}
        between = {"".join(p[2 * last + 1 : 2 * last + 2]) for p in cut}
        text += _group(roles[first], values, len(others) > 0)
        text += quoted(between.pop()) if len(between) == 1 else r"[/_\-. ]+"
    return f"{text}{ending}$"


def _group(role: str | None, values: set[str], several: bool) -> str:
    """Return the expression of the words at one place or at several."""
    if role is None:
        return quoted(next(iter(values)))
    if role == "other":
        return r"[^/]+?"
    if all(v.isdecimal() for v in values):
        return rf"(?P<{role}>\d+)"
    apart = ".+?" if any("_" in v or "/" in v for v in values) else "[^/_]+"
    return f"(?P<{role}>{'.+' if several else apart})"


def _tells_apart(pattern: str, paths: Sequence[str]) -> bool:
    """Tell whether every path fits, and no two are the same episode."""
    matches = [match.groupdict() for p in paths if (match := re.search(pattern, p))]
    return len({tuple(m.get(g) for g in (UNIT, CONDITION, EPISODE)) for m in matches}) == len(paths) == len(matches)
