"""What models, observers, forms and channels are called and coloured: the same in every figure, table and sentence."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import floor, isfinite, log10
from typing import Any

from ..data.population import DEFAULT_CONDITION, EpisodeKey
from .theme import Tone

_METHODS = {
    "open_loop": "open loop",
    "kalman_tuned": "tuned Kalman",
    "ekf": "extended Kalman",
    "mixed": "mixed H2-H∞",
    "paper": "mixed H2-H∞, entrywise weights",
    "h2": "H2",
    "hinf": "H∞",
    "worst_case_h2": "worst-case H2",
    "residual_h2": "residual-shaped H2",
    "memory": "subspace predictor",
    "filtered_difference": "filtered difference",
    "learned": "learned",
    "mean_profile": "mean profile",
}
_METHOD_TONES = {
    "open_loop": Tone.GREY,
    "kalman_tuned": Tone.PURPLE,
    "ekf": Tone.PURPLE,
    "filtered_difference": Tone.GOLD,
    "learned": Tone.GREEN,
    "mean_profile": Tone.GREEN,
}
BASELINES = tuple(_METHOD_TONES)
RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_UNITS = {"1": "fraction", "": ""}


@dataclass(frozen=True)
class Look:
    """Colour and line style of a curve; `weight` multiplies its width."""

    colour: str
    style: str = "-"
    weight: float = 1.0
    opacity: float = 1.0


def is_koopman(name: str) -> bool:
    """Tell whether a model, or the model of an observer, is a lifted one."""
    return name.startswith("koopman")


def split_observer(name: str) -> tuple[str, str]:
    """Return model and method of an observer; the model is empty for those that stand alone."""
    model, _, method = name.rpartition("/")
    return model, method


def model_label(name: str) -> str:
    """Return what a model is called, for example ``Koopman (EDMD)``."""
    family, _, kind = name.partition("_")
    label = {"koopman": "Koopman", "linear": "linear"}.get(family, family)
    return f"{label} ({'EDMD' if kind == 'edmd' else kind.replace('_', ' ')})" if kind else label


def observer_label(name: str) -> str:
    """Return what an observer is called, for example ``Koopman (EDMD), worst-case H2``."""
    model = split_observer(name)[0]
    return f"{model_label(model)}, {method_label(name)}" if model else method_label(name)


def method_label(name: str) -> str:
    """Return what an observer's method is called."""
    method = split_observer(name)[1]
    return _METHODS.get(method, method.replace("_", " "))


def model_look(name: str) -> Look:
    """Return how a model's curves look: Koopman blue, linear orange, the paper's recipe dashed where kros's own is there too."""
    return Look((Tone.BLUE if is_koopman(name) else Tone.ORANGE).light)


def observer_look(name: str) -> Look:
    """Return how an observer's curves look: hue by kind, linear ones orange, a linear baseline dashed."""
    model, method = split_observer(name)
    if method in _METHOD_TONES:
        return Look(_METHOD_TONES[method].light, "-" if is_koopman(model) or not model else "--")
    if is_koopman(model):
        return Look(
            {"mixed": Tone.GREEN, "paper": Tone.GREEN, "h2": Tone.SKY, "hinf": Tone.SKY}.get(method, Tone.BLUE).light
        )
    return Look(Tone.ORANGE.light, "--" if method in ("mixed", "paper") else "-")


def form_label(form: str) -> str:
    """Return what an uncertainty form is called."""
    return form.replace("_", " ")


def best_models(names: Iterable[str]) -> list[str]:
    """Return one linear and one Koopman model to compare: kros's own where there are any, else the paper's recipe."""
    known = list(names)
    chosen = [next((n for n in (family, f"{family}_edmd") if n in known), None) for family in ("linear", "koopman")]
    return [n for n in chosen if n is not None] or known[:2]


def deployed_pair(names: Sequence[str], deployed: str | None) -> list[str]:
    """Return the deployed observer and its linear twin, or without a robust twin what there is beside its tuned Kalman filter."""
    robust = [n for n in names if split_observer(n)[1] not in BASELINES]
    first = deployed if deployed is not None and deployed in names else (robust or list(names) or [""])[0]
    model, method = split_observer(first)
    other = model.replace("koopman", "linear") if is_koopman(model) else model.replace("linear", "koopman")
    twin = next(
        (n for n in (f"{other}/{m}" for m in (method, "worst_case_h2", "mixed", "kalman_tuned")) if n in names), ""
    )
    pair = [n for n in dict.fromkeys((twin, first)) if n in robust]
    if len(pair) > 1:
        return pair
    wanted = [n for n in dict.fromkeys((twin, f"{model}/kalman_tuned", first)) if n in names]
    return [n for n in wanted if split_observer(n)[1] != "open_loop"] or wanted


def paper_pair(names: Iterable[str]) -> list[str]:
    """Return the paper's linear and Koopman observer, or what there is of them: with its own entrywise weights where a study made these."""
    known = list(names)
    pairs = [
        [n for n in (f"linear_edmd/{method}", f"koopman_edmd/{method}") if n in known] for method in ("paper", "mixed")
    ]
    return max(pairs, key=len)


def readable_unit(unit: str) -> str:
    """Return a unit of measure for people; nothing where there is none."""
    return _UNITS.get(unit, unit)


def joined(parts: Sequence[str]) -> str:
    """Return a list for a sentence: with commas, and an "and" before the last."""
    return " and ".join(part for part in (", ".join(parts[:-1]), *parts[-1:]) if part)


def axis_label(channel: str, unit: str) -> str:
    """Return a channel's name with its unit of measure, for an axis."""
    readable = readable_unit(unit)
    name = channel.replace("_", " ")
    return f"{name} ({readable})" if readable else name


def channel_units(metrics: Mapping[str, Any]) -> dict[str, str]:
    """Return the unit of measure of every channel; nothing where the metrics do not say."""
    return dict(metrics["study"].get("channels", {}))


def squared(unit: str) -> str:
    """Return the square of a unit of measure, such as ``(rad/s)²``."""
    if unit in ("", "1"):
        return "1"
    return f"({unit})²" if set(unit) & set(" /·*") else f"{unit}²"


def episode_title(key: EpisodeKey) -> str:
    """Return what an episode is called above an axis."""
    where = "" if key.condition == DEFAULT_CONDITION else f"{condition_label(key.condition)}: "
    return shorten(f"{where}unit {key.unit}, episode {key.episode}", 46)


def condition_label(condition: str) -> str:
    """Return what a condition is called."""
    return {"noload": "no load", "load": "loaded"}.get(condition, condition)


def in_condition(condition: str) -> str:
    """Return a condition as a part of a sentence, with its comma; nothing for the only one of recordings that name none."""
    return "" if condition == DEFAULT_CONDITION else f", {condition_label(condition)}"


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
