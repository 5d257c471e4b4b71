"""Units of measure in headers and rows of units, the kinds of quantities they stand for, and names of channels."""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass

_TIMES = {1.0: "s sec seconds sek", 1e-3: "ms msec", 1e-6: "us µs μs", 1e-9: "ns", 60.0: "min", 3600.0: "h"}
SECONDS = {unit: factor for factor, units in _TIMES.items() for unit in units.split()}
_KINDS = {
    "angle": "rad mrad deg ° grad rev turn turns u umdr",
    "position": "m mm cm um µm μm km in inc counts cnt",
    "velocity": "rad/s deg/s °/s m/s mm/s cm/s rpm 1/min u/min min-1 min^-1 rev/s upm hz",
    "acceleration": "m/s2 m/s^2 m/s² rad/s2 rad/s^2 rad/s² deg/s² °/s²",
    "current": "a ma",
    "voltage": "v mv",
    "torque": "nm n·m n*m mnm knm ncm",
    "force": "n kn mn",
    "pressure": "pa kpa mpa hpa bar mbar psi",
    "temperature": "°c degc k °f c",
    "other": "w kw kg g % - 1 l/min l/s pct percent none bool hex dez",
    "time": " ".join(SECONDS),
}
KIND_OF = {unit: kind for kind, units in _KINDS.items() for unit in units.split()}
_ANGLES = {"deg ° grad": math.pi / 180, "mrad": 1e-3, "rev turn turns umdr": 2 * math.pi}
_SPEEDS = {"deg/s °/s": math.pi / 180, "rpm 1/min u/min min-1 min^-1 upm": math.pi / 30, "rev/s": 2 * math.pi}
_TO_RADIANS = {
    unit: (factor, base)
    for base, factors in (("rad", _ANGLES), ("rad/s", _SPEEDS))
    for units, factor in factors.items()
    for unit in units.split()
}
_BRACKETED = re.compile(r"^(.*?)[\s_]*[\[({<]\s*([^\[\](){}<>]*?)\s*[\])}>]\s*$")
_AFTER = re.compile(r"^(.+?)(?:\s+in\s+|\s*/\s*|\s*,\s*|\s+)(\S+)$")
_LETTERS = "ae oe ue ss Ae Oe Ue d omega phi theta alpha tau"
_SPELLED = dict(zip("äöüßÄÖÜΔωφθατ", _LETTERS.split(), strict=True))


@dataclass(frozen=True)
class Header:
    """A column's header: its name without the unit of measure, and the unit as it is written there."""

    name: str
    unit: str = ""


def known(unit: str) -> bool:
    """Tell whether a text is a unit of measure."""
    return _plain(unit) in KIND_OF


def _plain(unit: str) -> str:
    return _bare(unicodedata.normalize("NFC", unit)).lower().replace(" ", "").replace("º", "°")


def _bare(text: str) -> str:
    return text.strip().strip("[](){}").strip()


def split_header(text: str) -> Header:
    """Return the name and the unit in a header such as ``pos [mm]``, ``Weg in mm``, ``i/A`` or ``time_ms``."""
    text = text.strip()
    bracketed = _BRACKETED.match(text)
    if bracketed and bracketed[1]:
        return Header(bracketed[1].strip(), bracketed[2])
    after = _AFTER.match(text)
    if after and known(after[2]) and (len(after[2]) > 1 or "/" in text or " in " in text):
        return Header(after[1].strip(), after[2])
    stem, _, last = text.rpartition("_")
    if stem and known(last) and (len(last) > 1 or last == "s") and last not in ("in", "no", "none", "min"):
        return Header(stem, last)
    return Header(text)


def is_unit_row(cells: Sequence[str]) -> bool:
    """Tell whether a row holds units of measure."""
    written = [c.strip() for c in cells if c.strip()]
    units = sum(known(c) or (c.startswith("[") and c.endswith("]")) for c in written)
    return bool(written) and 2 * units > len(written)


def clean_unit(text: str) -> str:
    """Return a unit without brackets; nothing for a dash."""
    bare = _bare(text)
    return "" if bare in ("-", "1", "none") else {"°": "deg", "°/s": "deg/s"}.get(bare, bare)


def kind_of_unit(unit: str) -> str:
    """Return the kind of quantity a unit of measure stands for; nothing where it says none."""
    kind = KIND_OF.get(_plain(unit), "")
    return "" if kind == "other" else kind


def to_radians(unit: str) -> tuple[float, str] | None:
    """Return factor and unit that bring an angle or a speed to radians; None where nothing has to be done."""
    return _TO_RADIANS.get(_plain(unit))


def unit_of_factor(factor: float, unit: str) -> str:
    """Return the unit of measure that is so many radians, or radians per second; nothing where none is known."""
    sizes = ((name, size) for name, (size, base) in _TO_RADIANS.items() if base == unit)
    return next((name for name, size in sizes if math.isclose(size, factor, rel_tol=1e-6)), "")


def identifier(text: str, taken: Sequence[str] = ()) -> str:
    """Return a name for a channel that may stand in formulas and in C source, as close to the header as can be."""
    if text.isidentifier() and text.isascii() and text not in taken:
        return text
    spelled = "".join(_SPELLED.get(letter, letter) for letter in text)
    ascii_text = unicodedata.normalize("NFKD", spelled).encode("ascii", "ignore").decode().lower()
    name = re.sub(r"\W+", "_", ascii_text).strip("_") or "channel"
    name = name if name[0].isalpha() else f"c{name}"
    numbered = (f"{name}_{n}" for n in range(2, len(taken) + 3))
    return next(n for n in (name, *numbered) if n not in taken)
