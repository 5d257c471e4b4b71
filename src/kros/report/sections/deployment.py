"""What the deployed observer reads, estimates and needs, and what is certified about it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ...evaluate import Kind
from ..content import Section
from ..disturbances import doublings
from ..names import axis_label, joined, number, observer_about, observer_label, words
from ..verdict import measured_of

Facts = Mapping[str, Any]
_NEEDS = {
    Kind.NOISE: "noise of {} % of the largest value",
    Kind.QUANTISATION: "a resolution of {} %",
    Kind.BIAS: "a bias of {} %",
    Kind.DELAY: "an undeclared delay of {} samples",
    Kind.DROPPED: "{} % of the samples lost",
}


def deployment(metrics: Facts) -> Section | None:
    """Return the card of the deployed observer; None where there is none."""
    name = metrics["study"].get("deployed")
    if name is None:
        return None
    entry = metrics.get("observers", {}).get(name, {})
    about = f": {observer_about(name)}" if observer_about(name) else ""
    card = [
        ("Observer", [f"{observer_label(name)}{about} (observers/deployed.json)."]),
        *_interface(metrics),
        ("Sensor", _sensor(metrics)),
        ("Certificate assumes", [f"{'; '.join(entry['assumptions'])}."] if entry.get("assumptions") else []),
        ("Next machine", _next_unit(metrics)),
        ("Monitor", _monitor(entry.get("monitor"))),
    ]
    return Section("deployment", "Deployment", card=[(term, texts) for term, texts in card if texts])


def _interface(metrics: Facts) -> list[tuple[str, Sequence[str]]]:
    """Return signals, rate, delay, parameters, limits and size."""
    facts, units = metrics.get("deployment"), metrics["study"].get("channels", {})
    if not facts:
        return []
    largest, dt = facts["largest"], metrics["study"]["sample_period_s"]

    def named(names: Sequence[str]) -> str:
        sizes = {n: f" up to {number(largest[n])}" if n in largest else "" for n in names}
        return joined([axis_label(n, units.get(n, "")) + sizes[n] for n in names])

    hidden = [n for n in facts["estimates"] if n not in facts["measured"]]
    late = facts["delay_samples"]
    delay = f"a measurement delay of {late} samples is assumed" if late else "no measurement delay is assumed"
    limits = metrics["study"].get("limits", {})
    return [
        ("Reads", [f"Measured: {named(facts['measured'])}. Inputs: {named(facts['inputs'])}."]),
        ("Estimates", [f"{joined([axis_label(n, units.get(n, '')) for n in hidden])}, for the next sample; {delay}."]),
        ("Rate", [f"One step every {1e3 * dt:g} ms ({1 / dt:g} Hz), {facts['states']} states."]),
        ("Parameters", _parameters(metrics)),
        ("Limits", [f"{words(c)}: {_ends(own)}." for c, own in limits.items()]),
    ]


def _parameters(metrics: Facts) -> list[str]:
    """Say which numbers every machine needs, and how they are obtained."""
    parameters = metrics["deployment"]["parameters"]
    if not parameters:
        return []
    values = joined([f"{n} ({number(value)} on the nominal unit)" for n, value in parameters.items()])
    first = next(iter(parameters))
    how = f"every machine has its own value: --parameter UNIT.{first}=VALUE"
    if metrics.get("calibration"):
        how += f", or from recordings at constant speed in both directions, or --track {first}"
    return [f"{values}; {how}."]


def _ends(limit: Facts) -> str:
    """Return the ends of a limit in words."""
    ends = [(limit["lower"], "at least"), (limit["upper"], "at most")]
    text = joined([f"{word} {number(value)}" for value, word in ends if value is not None])
    return f"{text}, {'declared' if limit['declared'] else 'estimated from the recordings'}"


def _sensor(metrics: Facts) -> list[str]:
    """Say what the observer assumes of its sensors, and beyond which sensor its error doubles."""
    units, texts = metrics["study"].get("channels", {}), []
    for name, own in metrics.get("deployment", {}).get("sensor", {}).items():
        parts = [f"{words(key)} {number(value)}" for key, value in own.items() if value]
        texts += [f"Assumed for {axis_label(name, units.get(name, ''))}: {', '.join(parts)}."] if parts else []
    tried = doublings(metrics, measured_of(metrics)).get(metrics["study"]["deployed"], {})
    parts = [_NEEDS[kind].format(value) for kind, value in tried.items() if kind in _NEEDS and ">" not in value]
    return [*texts, f"The error doubles with {joined(parts).replace(' and ', ' or ')}."] if parts else texts


def _next_unit(metrics: Facts) -> list[str]:
    """Return the bound for the next machine from units in reserve."""
    facts = metrics.get("next_unit")
    if not facts:
        return []
    if facts["bounds"] is None:
        return [f"No bound: {facts['reason']}."]
    bounds = {c: own["error_percent"] for c, own in facts["bounds"].items() if own["error_percent"] is not None}
    parts = [f"{number(value)} % in {words(c)}" for c, value in bounds.items()]
    level = f"{100 * facts['confidence']:g} %"
    return [
        f"Its errors are at most {joined(parts)} with {level} confidence, from {facts['reserve']} units in reserve."
    ]


def _monitor(facts: Facts | None) -> list[str]:
    """Say what status bit 8 means, and how often it is wrong."""
    if not facts:
        return []
    text = (
        f"Status bit 8: the innovation is outside the envelope of {facts['units']} units. A good unit leaves it with a "
    )
    text += f"probability of {100 * facts['false_alarm_rate']:g} %"
    low, high = facts["alarms_per_hour"]
    if low is None:
        return [f"{text}."]
    rate = number(facts["alarms"] / facts["hours"], 2)
    return [f"{text}, {rate} times an hour in the recordings (95 % interval {number(low, 2)} to {number(high, 2)})."]
