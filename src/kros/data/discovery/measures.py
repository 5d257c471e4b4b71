"""Units of measure in headers and rows of units, the kinds of quantities they stand for, and names of channels."""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass

SECONDS = {
    "s": 1.0,
    "sec": 1.0,
    "seconds": 1.0,
    "sek": 1.0,
    "ms": 1e-3,
    "msec": 1e-3,
    "us": 1e-6,
    "µs": 1e-6,
    "μs": 1e-6,
    "ns": 1e-9,
    "min": 60.0,
    "h": 3600.0,
}
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
}
KIND_OF = {unit: kind for kind, units in _KINDS.items() for unit in units.split()} | {unit: "time" for unit in SECONDS}
_TO_RADIANS = {
    "deg": (math.pi / 180, "rad"),
    "°": (math.pi / 180, "rad"),
    "grad": (math.pi / 180, "rad"),
    "mrad": (1e-3, "rad"),
    "deg/s": (math.pi / 180, "rad/s"),
    "°/s": (math.pi / 180, "rad/s"),
    "rpm": (math.pi / 30, "rad/s"),
    "1/min": (math.pi / 30, "rad/s"),
    "u/min": (math.pi / 30, "rad/s"),
    "min-1": (math.pi / 30, "rad/s"),
    "min^-1": (math.pi / 30, "rad/s"),
    "upm": (math.pi / 30, "rad/s"),
    "rev/s": (2 * math.pi, "rad/s"),
    "rev": (2 * math.pi, "rad"),
    "turn": (2 * math.pi, "rad"),
    "turns": (2 * math.pi, "rad"),
    "umdr": (2 * math.pi, "rad"),
}
_BRACKETED = re.compile(r"^(.*?)[\s_]*[\[({<]\s*([^\[\](){}<>]*?)\s*[\])}>]\s*$")
_AFTER = re.compile(r"^(.+?)(?:\s+in\s+|\s*/\s*|\s*,\s*|\s+)(\S+)$")


@dataclass(frozen=True)
class Header:
    """A column's header: its name without the unit of measure, and the unit as it is written there."""

    name: str
    unit: str = ""


def known(unit: str) -> bool:
    """Tell whether a text is a unit of measure."""
    return _plain(unit) in KIND_OF


def _plain(unit: str) -> str:
    return unicodedata.normalize("NFC", unit).strip().strip("[](){}").strip().lower().replace(" ", "").replace("º", "°")


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
    written = [c for c in cells if c.strip()]
    return bool(written) and 2 * sum(known(c) or bool(re.match(r"^\[.*\]$", c.strip())) for c in written) > len(written)


def clean_unit(text: str) -> str:
    """Return a unit without brackets; nothing for a dash."""
    bare = text.strip().strip("[](){}").strip()
    return "" if bare in ("-", "1", "none") else {"°": "deg", "°/s": "deg/s"}.get(bare, bare)


def kind_of_unit(unit: str) -> str | None:
    """Return the kind of quantity a unit of measure stands for."""
    found = KIND_OF.get(_plain(unit))
    return None if found == "other" else found


def to_radians(unit: str) -> tuple[float, str] | None:
    """Return factor and unit that bring an angle or a speed to radians; None where nothing has to be done."""
    return _TO_RADIANS.get(_plain(unit))


def unit_of_factor(factor: float, unit: str) -> str:
    """Return the unit of measure that is so many radians, or radians per second; nothing where none is known."""
    return next(
        (
            name
            for name, (size, base) in _TO_RADIANS.items()
            if base == unit and math.isclose(size, factor, rel_tol=1e-6)
        ),
        "",
    )


def identifier(text: str, taken: Sequence[str] = ()) -> str:
    """Return a name for a channel that may stand in formulas and in C source, as close to the header as can be."""
    if text.isidentifier() and text.isascii() and text not in taken:
        return text
    spelled = text
    for letter, plain in zip(
        "äöüßÄÖÜΔωφθατ",
        ("ae", "oe", "ue", "ss", "Ae", "Oe", "Ue", "d", "omega", "phi", "theta", "alpha", "tau"),
        strict=True,
    ):
        spelled = spelled.replace(letter, plain)
    ascii_text = unicodedata.normalize("NFKD", spelled).encode("ascii", "ignore").decode().lower()
    name = re.sub(r"\W+", "_", ascii_text).strip("_") or "channel"
    name = name if name[0].isalpha() else f"c{name}"
    found, n = name, 2
    while found in taken:
        found, n = f"{name}_{n}", n + 1
    return found
