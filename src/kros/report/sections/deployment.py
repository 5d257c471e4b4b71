"""The deployment card: what the observer needs, gives and costs, what is certified about it, and what voids that."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ...core.artifacts import load_artifact
from ...observer import Observer
from ..content import Section
from ..disturbances import needed_sensor
from ..names import axis_label, channel_units, joined, number, observer_label
from ..run_folder import NotShownError, RunFolder
from ..trust import Trust, trust_of

Card = list[tuple[str, list[str]]]
_NEGLIGIBLE = 1e-12  # of the largest entry of a map: arithmetic that nobody would write down


def section(run: RunFolder, metrics: Mapping[str, Any]) -> Section | None:
    """Return the card of the deployed observer; None where there is none."""
    name = metrics["study"].get("deployed")
    if name is None:
        return None
    trust, units = trust_of(metrics.get("observers", {}).get(name, {})), channel_units(metrics)
    try:
        made = _made(run, run.observer, metrics, units)
    except NotShownError:
        made = []
    proof = [
        ("Certificate", _certificate(trust)),
        ("It assumes", _assumed(run, name)),
        ("It is void", _void(trust, metrics)),
        ("Monitor", _monitor(metrics.get("observers", {}).get(name, {}).get("monitor"))),
    ]
    card = [("Observer", [f"{observer_label(name)}, {name}, in observers/deployed.json."]), *made, *proof]
    return Section("deployment", "Deployment card", card=[(term, told) for term, told in card if told])


def _made(run: RunFolder, observer: Observer, metrics: Mapping[str, Any], units: Mapping[str, str]) -> Card:
    measured, dt = [observer.lifting.states[i] for i in observer.measured], observer.sample_period_s
    seen = (
        None
        if observer.seen is None
        else dict(zip([*measured, *observer.inputs], [*observer.seen.measured, *observer.seen.inputs], strict=True))
    )

    def named(names: Sequence[str]) -> str:
        return joined([axis_label(n, units.get(n, "")) + (f" up to {number(seen[n])}" if seen else "") for n in names])

    hidden = [c for c in observer.recorded if c not in measured]
    limits = metrics["study"].get("limits", {})
    beyond = " Samples beyond 1.5 times the sizes in training are refused." if seen else ""
    return [
        ("Reads", [f"Measured: {named(measured)}. Inputs: {named(observer.inputs)}.{beyond}"]),
        (
            "Gives",
            [
                f"Every step {joined([axis_label(c, units.get(c, '')) for c in (*measured, *hidden)])}; not measured: {joined(hidden)}."
            ],
        ),
        ("Rate", [f"One step every {1e3 * dt:g} ms ({1 / dt:g} Hz), at no other rate."]),
        ("Delay", _delay(observer)),
        ("Parameters", _parameters(run, observer)),
        (
            "Limits",
            [
                f"{c.replace('_', ' ')}: {_ends(own)}, {'declared' if own['declared'] else 'found in the recordings'}."
                for c, own in limits.items()
            ],
        ),
        ("Sensor", [*_assumed_sensor(observer, units), *needed_sensor(metrics, measured)]),
        ("Cost of a step", [_cost(observer)]),
        (
            "Run it",
            [
                "kros estimate RUN DATA estimates.csv on recordings; kros export c RUN OUT or kros export fmu RUN OUT.fmu for a machine."
            ],
        ),
    ]


def _assumed_sensor(observer: Observer, units: Mapping[str, str]) -> list[str]:
    """Say what the observer was told of its sensors, the resolution that was found included."""
    told = []
    for name, own in observer.about.get("sensor", {}).items():
        known = [f"{key.replace('_', ' ')} {number(value)}" for key, value in own.items() if value]
        told += [f"{axis_label(name, units.get(name, ''))}: {', '.join(known)}"] if known else []
    return [f"Assumed of {'; '.join(told)}."] if told else []


def _delay(observer: Observer) -> list[str]:
    late = observer.runtime.delay
    taken = (
        f"measurements count as {late} sample{'s' if late > 1 else ''} late"
        if late
        else "measurements count as of their own sample"
    )
    start = "at rest or in motion" if observer.start_in_motion is not None else "as from rest"
    return [
        f"An estimate is for the next sample, from data up to this one; {taken}. It starts at the first measurement, {start}."
    ]


def _parameters(run: RunFolder, observer: Observer) -> list[str]:
    names = observer.lifting.parameters
    if not names:
        return ["None: the same numbers run on every machine."]
    values = joined([f"{n} ({number(observer.parameters.get(n))} on the nominal unit)" for n in names])
    how = (
        "found by kros estimate where the machine's recordings have constant speed in both directions, or followed from the first sample on with "
        f"--track {names[0]}"
        if run.calibrated
        else "part of what is known of every unit"
    )
    return [f"{values}, of every machine its own: {how}; a known one is given with --parameter UNIT.{names[0]}=VALUE."]


def _ends(own: Mapping[str, Any]) -> str:
    return joined(
        [
            f"{word} {number(own[side])}"
            for side, word in (("lower", "at least"), ("upper", "at most"))
            if own[side] is not None
        ]
    )


def _cost(observer: Observer) -> str:
    step, functions = observer.one_step, len(observer.lifting.functions)
    products = int((np.abs(step) > _NEGLIGIBLE * np.abs(step).max()).sum())
    states = observer.lifting.n_states + observer.controller.n_states
    lifted = f" and {functions} lifted function{'s' if functions > 1 else ''}" if functions else ""
    return f"{states} states, {products} multiply-adds{lifted}; exported C leaves out more, and its README has bytes and instructions."


def _certificate(trust: Trust) -> list[str]:
    told = [
        f"As it runs: {trust.as_it_runs} from the model's one-step residual to the error, on any machine."
        if trust.running
        else "As it runs: none."
    ]
    if trust.plants is not None:
        told.append(f"For the set of plants: H2 norm of the error at most {number(trust.plants)}.")
    if trust.signals:
        bounds = joined([f"{number(value)} % in {state.replace('_', ' ')}" for state, value in trust.signals.items()])
        told.append(f"For the set of recorded signals: RMS error of at most {bounds} (of the largest value).")
    return told


def _assumed(run: RunFolder, name: str) -> list[str]:
    if not run.has("observers/relift.json"):
        return []
    assumptions = (
        load_artifact(run.folder / "observers", "relift")[0]["certificates"].get(name, {}).get("assumptions", [])
    )
    return [f"{'; '.join(assumptions)}."] if assumptions else []


def _void(trust: Trust, metrics: Mapping[str, Any]) -> list[str]:
    """Say what the numbers do not hold for, the most frequent mistake first."""
    told = []
    if trust.signals or trust.plants is not None:
        told += [
            "When a loop is closed on the estimate: the set was recorded with signals that did not depend on it.",
            "For signals with more power at some frequency than was recorded, and beyond the sizes in training.",
            "On a machine that is worn, badly assembled or of another batch.",
        ]
    told += [
        f"At another rate than {1 / metrics['study']['sample_period_s']:g} Hz, and with another sensor, delay or loss of samples than it was told of."
    ]
    told += [f"On {joined(trust.outside)}, whose recorded signals are outside the set."] if trust.outside else []
    return told


def _monitor(found: Mapping[str, Any] | None) -> list[str]:
    """Say what the running observer tells of the machine, and at which rates it is wrong; nothing where it has no envelope."""
    if not found:
        return []
    text = (
        f"Status bit 8 is set while the innovation is outside the envelope of {found['units']} units. One more good unit leaves it with a probability of "
        f"{100 * found['false_alarm_rate']:g} %"
    )
    low, high = found["alarms_per_hour"]
    if low is None:
        return [f"{text}."]
    return [
        f"{text}, and {number(found['alarms'] / found['hours'])} times an hour of operation (95 % interval {number(low, 2)} to {number(high, 2)})."
    ]
