"""What the deployed observer reads, estimates and needs, and what is certified about it."""

from collections.abc import Mapping, Sequence

from ...core import ByName
from ..content import Column, Section, Table, build
from ..facts import Facts
from ..names import joined, label_of, number, words

_ERRORS = {
    "noise": "white noise, standard deviation",
    "bias": "constant offset",
    "bounded": "any error of at most this size, such as rounding",
}
_GAINS = (
    "The table is computed from gains of the observer's linear part: the H2 norm for white noise, the gain at zero "
    "frequency for an offset, the sum of the absolute impulse response for bounded errors. They add to what the "
    "recordings already contain."
)


def deployment(facts: Facts) -> Section | None:
    """Return the card of the deployed observer; None where there is none."""
    if not facts.deployed:
        return None
    about = label_of(facts.deployed).about
    about = f": {about}" if about else ""
    entry = facts.get("deployment")
    card = [
        ("Observer", [f"{facts.label}{about} (observers/deployed.json)."]),
        *(_interface(facts, entry) if entry else []),
        ("Next unit", _next_unit(facts.get("next_unit"))),
        ("Monitor", _monitor(facts.entry.get("monitor"))),
    ]
    table = _needed(facts, entry)
    return Section("deployment", "Deployment", [_GAINS] if table else [], card, [table])


def _needed(facts: Facts, entry: ByName) -> Table | None:
    """Return the errors of measurements that cost one percent in each estimate; None where no gain is known."""
    rows = []
    for channel, kinds in entry.get("sensor_gains", {}).items():
        share = entry["largest"][channel] / 100
        for kind, gains in kinds.items():
            sizes = {state: share / gain for state, gain in gains.items() if gain}
            rows.append({"error": f"{facts.axis(channel)}: {_ERRORS[kind]}", **sizes})
    columns = [Column(words(state), state) for state in entry.get("estimates", ()) if state not in entry["measured"]]
    return build(
        "Error of a measurement that costs 1 % of the largest value of an estimate", [Column("error"), *columns], rows
    )


def _interface(facts: Facts, entry: ByName) -> list[tuple[str, Sequence[str]]]:
    """Return signals, rate, delay, parameters and sensor."""
    largest, dt, late = entry["largest"], facts.study["sample_period_s"], entry["delay_samples"]

    def named(names: Sequence[str]) -> str:
        return joined([f"{facts.axis(n)} up to {number(largest[n])}" for n in names])

    hidden = [facts.axis(n) for n in entry["estimates"] if n not in entry["measured"]]
    delay = f"a measurement delay of {late} samples is assumed" if late else "no measurement delay is assumed"
    sensors = entry["sensor"].items()
    assumed = {n: ", ".join(f"{words(k)} {number(v)}" for k, v in sensor.items() if v) for n, sensor in sensors}
    return [
        ("Reads", [f"Measured: {named(entry['measured'])}. Inputs: {named(entry['inputs'])}."]),
        ("Estimates", [f"{joined(hidden)}, for the next sample; {delay}."]),
        ("Rate", [f"One step every {dt:g} s ({1 / dt:g} Hz), {entry['states']} states."]),
        ("Parameters", _parameters(entry["parameters"])),
        ("Sensor", [f"Assumed for {facts.axis(n)}: {text}." for n, text in assumed.items() if text]),
    ]


def _parameters(parameters: Mapping[str, float | None]) -> list[str]:
    """Say which numbers every unit needs, and how they are obtained."""
    if not parameters:
        return []
    values = joined([f"{n} ({number(value)} on the nominal unit)" for n, value in parameters.items()])
    first = next(iter(parameters))
    how = f"--parameter UNIT.{first}=VALUE, from recordings at constant speed in both directions, or --track {first}"
    return [f"{values}; every unit has its own value: {how}."]


def _next_unit(entry: ByName | None) -> list[str]:
    """Return the bound for the next unit from units in reserve."""
    if not entry:
        return []
    if entry["bounds"] is None:
        return [f"No bound: {entry['reason']}."]
    bounds = {c: bound["error_percent"] for c, bound in entry["bounds"].items() if bound["error_percent"] is not None}
    text = joined([f"{number(value)} % in {words(c)}" for c, value in bounds.items()])
    level = f"{100 * entry['confidence']:g} %"
    return [f"Its errors are at most {text} with {level} confidence ({entry['reserve']} units in reserve)."]


def _monitor(entry: ByName | None) -> list[str]:
    """Say what status bit 8 means, and how often it is wrong."""
    if not entry:
        return []
    rate = f"{100 * entry['false_alarm_rate']:g} %"
    text = f"Status bit 8: the innovation is outside the envelope of {entry['units']} units, that of a good unit"
    return [f"{text} with a probability of {rate}."]
