"""Units of measure: how headers write them, what kind of quantity they measure, and their conversion to SI by pint."""

import math
import re
import unicodedata
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

from ..core import AGREED

# SI units as kros writes them, with the kind of quantity
_SI = """
rad angle|rad/s velocity|rad/s^2 acceleration|m position|m/s velocity|m/s^2 acceleration|s time|Hz velocity|A current
V voltage|N m torque|N force|Pa pressure|K temperature|W other|kg other|ohm other|H other|F other|T other
"""
# what is written otherwise than pint does, and German
_SPELLED = """
° deg|grad deg|rev turn|revs turn|turns turn|u turn|umdr turn|upm rpm|1/min rpm|u/min rpm|min-1 rpm|min^-1 rpm|1/s Hz
rev/s turn/s|rev/min rpm|a A|v V|w W|n N|pa Pa|kpa kPa|hz Hz|k K|c degC|°c degC|°f degF|sek s|°/s deg/s|°/s^2 deg/s^2
Nm N*m|mNm mN*m|kNm kN*m|Ncm N*cm|kn kN|mps m/s
"""
# what is a unit without brackets, too, in the order in which names are chosen
_WORDS = """
rad mrad deg ° grad rev turn turns U umdr m mm cm µm μm um km in inch counts cnt rad/s deg/s °/s m/s mps mm/s cm/s km/h
rpm 1/min u/min min-1 min^-1 rev/s upm Hz m/s2 m/s^2 m/s² rad/s2 rad/s^2 rad/s² deg/s² °/s² A mA kA V mV kV Nm N·m
N*m mNm kNm Ncm N kN MN Pa kPa MPa hPa bar mbar psi °C degC K °F degF C W kW kg g % - 1 l/min l/s pct percent none bool
hex dez s sec seconds sek ms msec us µs μs ns min h
"""
_MORE = """
degree degrees radian meter metre millimeter second minute hour volt amp amps ampere newton pascal watt kelvin celsius
degree_Celsius volts hertz kHz MHz GPa kWh mW MW uA uV nA nm mH uH Ohm mF uF nF mT mbar torr atm lbf ft lb t
gravity milligravity
"""  # that pint knows too
_QUANTITIES = {
    "input": "target desired des cmd command commanded setpoint soll sollwert sollposition solldrehzahl ref reference "
    "sollgeschwindigkeit consigne con ctrl control input inputs pwm duty stell stellgroesse stellwert feedforward "
    "demand demanded set vorgabe commande u",
    "spare": "filt filtered smooth smoothed index idx sample samples counter count nr no number status flag error err "
    "saturation sat mode id fault fehler zaehler",
    "time": "time zeit t timestamp timestamps date datum uhrzeit clock temps tijd tiempo tempo secs seconds millis "
    "datetime zeitstempel elapsed",
    "angle": "angle winkel theta phi alpha beta gamma q encoder enc rotation drehwinkel angolo",
    "position": "pos position lage weg stroke hub displacement x y z istposition posizione travel",
    "velocity": "vel velocity speed drehzahl geschwindigkeit omega rpm rate v w dq qd vitesse istdrehzahl velocita",
    "acceleration": "acc accel acceleration beschleunigung",
    "current": "current strom i iq courant amp amps corrente motorstrom",
    "torque": "torque tau moment drehmoment couple coppia",
    "force": "force kraft f effort forza",
    "pressure": "pressure druck p pression oeldruck",
    "temperature": "temp temperature temperatur",
    "voltage": "volt voltage spannung tension",
}
# symbols that mean something else in channels of one kind, by name
_OF_KIND = {
    "acceleration": {"g": "gravity", "G": "gravity", "mg": "milligravity"},
    "temperature": {"F": "degF", "f": "degF"},
    "torque": {"nm": "N*m", "NM": "N*m"},
}
_OF_WORD = {word: kind for kind, words in _QUANTITIES.items() for word in words.split()}
_LETTERS = "ae oe ue ss Ae Oe Ue d omega phi theta alpha tau"
_LATIN = dict(zip("äöüßÄÖÜΔωφθατ", _LETTERS.split(), strict=True))
_EXPRESSION = re.compile(r"[^\W\d_]+(?:\^-?\d)?(?:[*/ ][^\W\d_]+(?:\^-?\d)?)*")
_BRACKETED = re.compile(r"^(.*?)[\s_]*[\[({<]\s*([^\[\](){}<>]*?)\s*[\])}>]\s*$")
_AFTER = re.compile(r"^(.+?)(?:\s+in\s+|\s*/\s*|\s*,\s*|\s+)(\S+)$")


def _pairs(table: str) -> dict[str, str]:
    return {name: text for row in re.split(r"[|\n]", table.strip()) for name, _, text in [row.rpartition(" ")]}


KINDS = _pairs(_SI)
ZERO_OF_CELSIUS = 273.15  # K
_PINT = _pairs(_SPELLED)
_KNOWN = set(re.findall(r"[^\W\d_]+", _SI + _SPELLED + _WORDS + _MORE)) - {"pct", "F", "none", "bool", "hex", "dez"}


@dataclass(frozen=True)
class Measure:
    """A unit of measure: a value in it, times `factor` plus `offset`, is the value in the unit `si`."""

    si: str
    factor: float
    offset: float


def bare(text: str) -> str:
    """Return a unit without brackets and spaces around it."""
    return unicodedata.normalize("NFC", text).strip().strip("[](){}").strip().replace("º", "°")


def is_word(text: str) -> bool:
    """Tell whether a text is a unit of measure where no bracket says so."""
    return bare(text).lower().replace(" ", "") in {word.lower() for word in _WORDS.split()}


def clean_unit(text: str) -> str:
    """Return a unit without brackets; nothing for a dash."""
    return {"-": "", "1": "", "none": "", "°": "deg", "°/s": "deg/s"}.get(bare(text), bare(text))


@cache
def _registry() -> tuple[Any, dict[Any, str]]:
    """Return the registry of pint, and the SI units of `_SI` by what they are in base units."""
    import pint

    registry: Any = pint.UnitRegistry(autoconvert_offset_to_baseunit=True)
    return registry, {_in_base(registry, 1, name).units: name for name in KINDS}


def _in_base(registry: Any, value: float, unit: str) -> Any:
    return registry.Quantity(value, registry.parse_units(unit)).to_base_units()


@cache
def measure(unit: str, name: str = "") -> Measure | None:
    """Return what a text measures in a channel of a name; None where it is no unit that kros converts to SI."""
    unit = _OF_KIND.get(_named_kind(name), {}).get(bare(unit), unit)
    text = re.sub(r"(?<=[a-zA-Z])([23])$", r"^\1", bare(unit).replace("²", "^2").replace("³", "^3").replace("·", "*"))
    text = _PINT.get(text, _PINT.get(text.lower().replace(" ", ""), text))
    return _measured(text) or (_measured(text.lower()) if len(text) > 2 else None)  # Volts, RPM


def _measured(text: str) -> Measure | None:
    """Return what an expression of pint measures."""
    parts = set(re.findall(r"[^\W\d_]+", text))
    if not _EXPRESSION.fullmatch(text) or not parts <= _KNOWN:  # pint computes what it parses, and pct is a pico-carat
        return None
    registry, names = _registry()
    try:
        zero, one, two = (_in_base(registry, value, text) for value in (0, 1, 2))
    except Exception:
        return None  # the errors of pint for what it does not know have no common base
    linear = math.isclose(two.magnitude - one.magnitude, one.magnitude - zero.magnitude, rel_tol=AGREED)
    if one.units not in names or not linear:
        return None
    return Measure(names[one.units], float((one - zero).magnitude), float(zero.magnitude))


def unit_of_factor(factor: float, unit: str) -> str:
    """Return the unit of measure with the zero of an SI unit that is so many of it; nothing where none is known."""
    for name in _WORDS.split():
        m = measure(name)
        if m is not None and (m.si, m.offset) == (unit, 0) and math.isclose(m.factor, factor, rel_tol=AGREED):
            return name
    return ""


def identifier(text: str, taken: Collection[str] = ()) -> str:
    """Return a name for a channel that may stand in formulas and in C source, as close to the header as can be."""
    if text.isidentifier() and text.isascii() and text not in taken:
        return text
    spelled = "".join(_LATIN.get(letter, letter) for letter in text)
    ascii_text = unicodedata.normalize("NFKD", spelled).encode("ascii", "ignore").decode().lower()
    name = re.sub(r"\W+", "_", ascii_text).strip("_") or "channel"
    name = name if name[0].isalpha() else f"c{name}"
    numbered = (f"{name}_{n}" for n in range(2, len(taken) + 3))
    return next(n for n in (name, *numbered) if n not in taken)


def words_of(name: str) -> list[str]:
    """Return the kinds that the words of a name stand for, with nothing for words that are not known."""
    apart = re.sub(r"([a-z])([A-Z])", r"\1 \2", name)
    words = identifier(f"{apart} ").lower().split("_")
    return [_OF_WORD.get(re.sub(r"\d+$", "", word), "input" if word.startswith("soll") else "") for word in words]


def kind_of(name: str, unit: str = "") -> str:
    """Return the kind of quantity that a channel is, by its unit of measure or its name, or nothing."""
    known = measure(unit, name)
    kind = "other" if known is None else KINDS[known.si]
    return _named_kind(name) if kind == "other" else kind


def _named_kind(name: str) -> str:
    """Return the kind of quantity that a name has a word for, or nothing."""
    return next((of for of in words_of(name) if of not in ("", "input", "spare")), "")


def split_header(text: str) -> tuple[str, str]:
    """Return the name and the unit in a header such as ``pos [mm]``, ``Weg in mm``, ``i/A``, ``v_m/s`` or ``v_m_s``."""
    text = text.strip()
    bracketed, after = _BRACKETED.match(text), _AFTER.match(text)
    if bracketed and bracketed[1]:
        return bracketed[1].strip(), bracketed[2]
    words, marked = text.replace("_per_", "_").split("_"), "/" in text or " in " in text
    counts = range(min(2, len(words) - 1), 0, -1)  # rate_deg_s, then time_s
    ends = [("_".join(words[:-count]), "/".join(words[-count:]), False) for count in counts]
    ends += [(after[1].strip(), after[2], marked)] if after else []
    return next(((stem, last) for stem, last, clear in ends if stem and _is_unit(last, stem, clear)), (text, ""))


def _is_unit(last: str, stem: str, marked: bool) -> bool:
    """Tell whether the last word of a header is a unit: of several letters, or of the kind that the others name."""
    known, kind = measure(last) if last in _WORDS.split() else None, kind_of(stem)
    fits = known is not None and kind == KINDS[known.si]  # i_A, and not v_A or i_s
    unknown = kind == "" and last in KINDS and last.isupper()  # bus_V
    return fits or unknown or (is_word(last) and (marked or (len(last) > 1 and last not in ("in", "none", "min"))))


def is_unit_row(cells: Sequence[str]) -> bool:
    """Tell whether a row holds units of measure."""
    written = [c.strip() for c in cells if c.strip()]
    units = sum(is_word(c) or (c.startswith("[") and c.endswith("]")) for c in written)
    return bool(written) and 2 * units > len(written)
