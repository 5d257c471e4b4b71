"""Compare a run of `run.py` with the claims of the paper, as a table in Markdown.

Reads `metrics.json` alone, so it accepts any study with the paper's models. `--method` names the pair of observers.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

Metrics = Mapping[str, Any]
KINDS = {"Koopman": "koopman_edmd", "linear": "linear_edmd"}


def both(describe: Callable[[str], str]) -> str:
    """Return the descriptions of the linear and of the Koopman model."""
    return "; ".join(f"{word} {describe(kind)}" for word, kind in reversed(KINDS.items()))


def value(metrics: Metrics, observer: str, key: str, channel: str, condition: str, role: str) -> float:
    """Return the mean over the units of a role."""
    wanted = {"observer": observer, "channel": channel, "condition": condition, "role": role}
    return float(np.mean([row[key] for row in metrics["evaluation"] if all(row[k] == v for k, v in wanted.items())]))


def ripple_db(metrics: Metrics, method: str, channel: str, condition: str, role: str) -> float:
    """Return the power of the Koopman observer's error around the gearbox frequency relative to that of the linear observer, dB."""
    koopman, linear = (
        value(metrics, f"{kind}/{method}", "gearbox_band_power", channel, condition, role) for kind in KINDS.values()
    )
    return float(10 * np.log10(koopman / linear))


def forms(metrics: Metrics, kind: str) -> str:
    """Return the peak of every form, smallest first."""
    peaks = sorted(metrics["uncertainty"][kind]["peak_db"].items(), key=lambda item: item[1])
    return ", ".join(f"{name.replace('_', ' ')} {peak:.1f}" for name, peak in peaks) + " dB"


def errors(metrics: Metrics, method: str, role: str, condition: str) -> str:
    """Return the errors of velocity and current of both observers, percent of the largest value."""

    def describe(kind: str) -> str:
        percent = [
            value(metrics, f"{kind}/{method}", "error_percent", channel, condition, role)
            for channel in ("velocity", "current")
        ]
        return f"{percent[0]:.2f}, {percent[1]:.1f} %"

    return both(describe)


def outliers(metrics: Metrics, condition: str) -> str:
    """Return the excess of the badly assembled drive over the others, its range over all nominals, and the threshold."""
    planted = {unit["unit"] for unit in metrics["units"] if unit["group"] == "outliers"}
    rows = [row for row in metrics["outliers"] if row["condition"] == condition and row["score"] is not None]

    def decibels(value: float | None) -> str:
        return "none" if value is None else f"{value:.1f} dB"

    excess = [
        f"{decibels(row['score'])} above all others, {decibels(row['lowest_db'])} to {decibels(row['highest_db'])} over the choices of nominal; "
        f"threshold for rare false alarms {decibels(row['threshold'])}, {'flagged' if row['outlier'] else 'not flagged'}"
        for row in rows
        if row["unit"] in planted
    ]
    others = [row["score"] for row in rows if row["unit"] not in planted]
    return f"{'; '.join(excess) or 'no such drive'}; the highest of the others {max(others):.1f} dB"


def claims(metrics: Metrics, method: str = "mixed") -> Iterator[tuple[str, str, str]]:
    """Yield section, claim and result."""
    study, on = metrics["study"], metrics["study"]["identify_on"]
    loaded = next((c for c in study["conditions"] if c != on), None)
    yield (
        "IV-A",
        "38 drives, loaded and unloaded, 1 kHz",
        f"{study['units']} drives, {', '.join(study['conditions'])}, {1 / study['sample_period_s']:g} Hz",
    )
    radius = both(lambda kind: f"{metrics['models'][kind]['spectral_radius_max']:.3f}")
    yield (
        "IV-B.2",
        "alpha = 90 stabilises all models, linear and Koopman",
        f"alpha = {study['alpha']:g}, largest spectral radius: {radius}",
    )

    def simulation(kind: str) -> str:
        percent = metrics["models"][kind]["freerun_error_percent"]
        return f"{percent['velocity']['median']:.2f}, {percent['current']['median']:.1f} %"

    text = "Koopman models predict the oscillation; more low-frequency error of the current"
    yield "IV-B.3, Fig. 5, 6", text, f"median simulation error of velocity, current: {both(simulation)}"
    text = "Both output multiplicative forms are high everywhere; both input multiplicative ones below 0 dB"
    yield "IV-C, Fig. 7", text, f"peaks: {both(lambda kind: forms(metrics, kind))}"
    nominals = both(lambda kind: str(metrics["uncertainty"][kind]["nominal"]))
    yield "IV-C", "The unit with the lowest peak is the nominal one, the same for both", nominals
    orders = both(lambda kind: f"{metrics['uncertainty'][kind]['weight']['orders']}")
    yield (
        "IV-C, Fig. 8",
        "Weights of order 1 to 2 (linear), 3 and once 1 (Koopman), an entry each",
        f"orders of W_L and W_R: {orders}",
    )
    designs = both(
        lambda kind: (
            f"{metrics['observers'][f'{kind}/{method}'].get('status')}, order {metrics['observers'][f'{kind}/{method}']['order']}"
        )
    )
    yield "IV-D", "A mixed H2 and H-infinity observer exists for both", designs
    for role, words in (("nominal", "nominal"), ("off_nominal", "off-nominal, mean over all")):
        result = ", ".join(
            f"{channel} {ripple_db(metrics, method, channel, on, role):+.1f} dB" for channel in ("velocity", "current")
        )
        yield (
            "IV-E.1, Fig. 12",
            f"The Koopman observer reduces errors at the gearbox frequency, {words}",
            f"Koopman against linear: {result}",
        )
        yield "IV-E.1, Fig. 11", f"Errors of velocity and current, {words}", errors(metrics, method, role, on)
    if f"{KINDS['linear']}/open_loop" in metrics["observers"]:
        result = errors(metrics, "open_loop", "off_nominal", on)
        yield (
            "IV-D.2, Fig. 10",
            "The correction acts where uncertainty is high",
            f"the models alone, off-nominal: {result}",
        )
    if loaded is not None:
        result = f"Koopman against linear, current: {ripple_db(metrics, method, 'current', loaded, 'nominal'):+.1f} dB"
        yield "IV-E.2, Fig. 14", "The load torque estimate holds less of the gearbox's disturbance", result
        yield (
            "Appendix A, Fig. 15",
            "A badly installed drive exceeds the bounds; under all nominals but one",
            outliers(metrics, loaded),
        )
    phases = [unit["concentration"] for unit in metrics["units"] if unit.get("concentration") is not None]
    yield (
        "Appendix B",
        "Segments of constant velocity agree on a phase",
        f"least concentration (1: all alike) {min(phases):.6f}",
    )


def table(metrics: Metrics, method: str = "mixed") -> str:
    """Return the claims as a table."""
    rows = [("section", "claim", "result"), ("---",) * 3, *claims(metrics, method)]
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("--method", default="mixed", help="mixed or paper")
    chosen = parser.parse_args()
    print(table(json.loads((chosen.run / "metrics.json").read_text(encoding="utf-8")), chosen.method))
