"""What models, observers and channels are called and coloured: the same in every figure, table and sentence."""

from collections.abc import Iterable, Mapping, Sequence
from math import floor, isfinite, log10

from ..core import frozen
from ..core.arrays import T
from ..data import DEFAULT_CONDITION, EpisodeKey
from ..design.baselines import BASELINES
from ..design.methods import METHODS
from ..design.task import Label, split_name
from .theme import Tone

LABELS = {method.name: method.label for method in METHODS} | BASELINES
RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


@frozen
class Look:
    """Colour and line style of a curve; `weight` multiplies its width."""

    colour: str
    style: str = "-"
    weight: float = 1.0
    opacity: float = 1.0


def is_koopman(name: str) -> bool:
    """Tell whether a model, or the model of an observer, is a lifted one."""
    return name.startswith("koopman")


def words(name: str) -> str:
    """Return an identifier, such as that of a channel or a form, as words."""
    return name.replace("_", " ")


def model_label(name: str) -> str:
    """Return what a model is called, for example ``Koopman (EDMD)``."""
    family, _, edmd = name.partition("_")
    return f"{'Koopman' if is_koopman(name) else family}{' (EDMD)' if edmd else ''}"


def label_of(name: str) -> Label:
    """Return the label of an observer's method."""
    method = split_name(name)[1]
    return LABELS.get(method, Label(words(method), ""))


def observer_label(name: str) -> str:
    """Return what an observer is called, for example ``Koopman (EDMD), worst-case H2``."""
    model, text = split_name(name)[0], label_of(name).text
    return f"{model_label(model)}, {text}" if model else text


def model_look(name: str) -> Look:
    """Return how a model's curves look: Koopman blue, linear orange."""
    return Look(Tone.BLUE if is_koopman(name) else Tone.ORANGE)


def method_look(name: str) -> Look:
    """Return how an observer's curves look beside others of the same model: the hue of its method."""
    label = label_of(name)
    return Look(Tone[label.tone], label.line)


def observer_look(name: str) -> Look:
    """Return how an observer's curves look beside others: the hue of its model, of a baseline that of its method."""
    model = split_name(name)[0]
    return method_look(name) if label_of(name).baseline or not model else model_look(model)


def linear_first(by_model: Mapping[str, T]) -> dict[str, T]:
    """Return what belongs to models in the order in which these are compared."""
    return dict(sorted(by_model.items(), key=lambda item: is_koopman(item[0])))


def observer_pair(names: Iterable[str], first: str | None = None) -> list[str]:
    """Return an observer, by default the first, behind that of its method for the other model; else a baseline."""
    known = list(names)
    first = first if first in known else next(iter(known), "")
    model, method = split_name(str(first))
    rivals = [n for n in known if split_name(n)[1] == method] + [f"{model}/kalman_tuned", "learned"]
    rival = next((n for n in rivals if n in known and n != first), None)
    return [n for n in (rival, first) if n]


def published(names: Iterable[str]) -> list[str]:
    """Return the paper's observers, those with entrywise weights first."""
    return [n for n in names if split_name(n)[1] in ("paper", "mixed")]


def readable_unit(unit: str) -> str:
    """Return a unit of measure for people; nothing where there is none."""
    return "" if unit == "1" else unit


def squared(unit: str) -> str:
    """Return the square of a unit of measure, such as ``(rad/s)²``."""
    if unit in ("", "1"):
        return "1"
    return f"({unit})²" if set(unit) & set(" /·*") else f"{unit}²"


def joined(parts: Sequence[str]) -> str:
    """Return a list for a sentence: with commas, and an "and" before the last."""
    return " and ".join(part for part in (", ".join(parts[:-1]), *parts[-1:]) if part)


def episode_title(key: EpisodeKey) -> str:
    """Return what an episode is called above an axis."""
    where = condition_label(key.condition)
    return shorten(f"{where}{': ' if where else ''}unit {key.unit}, episode {key.episode}", 46)


def condition_label(condition: str) -> str:
    """Return what a condition is called; nothing for the only one of recordings that name none."""
    return {"noload": "no load", "load": "loaded", DEFAULT_CONDITION: ""}.get(condition, condition)


def in_condition(condition: str) -> str:
    """Return a condition as a part of a sentence, with its comma."""
    return f", {condition_label(condition)}" if condition_label(condition) else ""


def shorten(text: str, most: int) -> str:
    """Return a text cut to a number of characters."""
    return text if len(text) <= most else f"{text[: most - 1]}…"


def number(value: float | None, digits: int = 3) -> str:
    """Return a number for people, by default with three significant digits; what is unknown is a dash."""
    if value is None or not isfinite(value):
        return "–"
    size = abs(value)
    if size >= 10 ** (digits + 2) or 0 < size < 1e-4:
        mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
        return minus(f"{mantissa}·10{str(int(exponent)).translate(RAISED)}")
    decimals = max(digits - 1 - floor(log10(size)), 0) if size else 0
    return minus(f"{value:.{decimals}f}")


def minus(text: str) -> str:
    """Return a number's text with a proper minus sign."""
    return text.replace("-", "−")
