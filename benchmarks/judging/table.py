"""What the judge prints: ratios to the learned estimator, worst-case designs over the open loop, bounds over errors, and whether what is asked is met."""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from kros.core.artifacts import read_json

HOME, LEARNED, FOLDS = "noload", "learned", 3
LIMITED = ("limit",)  # variants of a population
REACHED = 0.005  # share of an episode's samples at the limit from which on it counts
DRAWS = 4000  # of the bootstrap
PROOFS = r"certified|robust|worst_case|bound|gain$|hidden_error"  # facts of the deployed observer that are printed


def read_parts(out: Path, name: str, part: str) -> list[dict[str, Any]]:
    """Return the results of a population's folds that are there."""
    return [read_json(path) for path in sorted((out / name.replace(":", "-")).glob(f"{part}-*.json"))]


def errors(
    parts: Sequence[Mapping[str, Any]],
    observer: str,
    condition: str,
    channel: str,
    what: str = "error_percent",
    **case: Any,
) -> dict[str, float]:
    """Return an observer's error of every unit; `deployed` is every fold's own. Infinite where it diverged, absent where it was not made."""
    found = {}
    for part in parts:
        wanted = part["deployed"] if observer == "deployed" else observer
        if isinstance(wanted, Mapping):
            wanted = wanted[case["case"] if case["told"] else ""]
        for r in part["rows"]:
            if (r["observer"], r["condition"], r["channel"]) == (wanted, condition, channel) and all(
                r[k] == v for k, v in case.items()
            ):
                found[f"{part['fold']}/{r['unit']}"] = np.inf if r[what] is None else float(r[what])
    return found


def paired(own: Mapping[str, float], other: Mapping[str, float]) -> np.ndarray:
    """Return ratios over the units that both have."""
    return np.array([own[u] / other[u] for u in own if u in other and np.isfinite(other[u]) and other[u] > 0])


def upper(values: np.ndarray) -> float:
    """Return the upper 95 % limit of a mean by bootstrap over units."""
    rows = np.random.default_rng(0).integers(len(values), size=(DRAWS, len(values)))
    return float(np.quantile(values[rows].mean(axis=1), 0.95))


def ratio(own: Mapping[str, float], other: Mapping[str, float], text: str) -> str:
    """Return mean, upper limit and worst unit of a ratio."""
    values = paired(own, other)
    if not len(values):
        return f"{text:58s} not there"
    return f"{text:58s} {values.mean():7.3f} {upper(values):7.3f} {values.max():7.3f}   ({len(values)} units)"


def table(out: Path, names: Sequence[str]) -> None:
    """Print everything that is there."""
    for name in names:
        if parts := read_parts(out, name, "accuracy"):
            say(
                f"\n== {name}: {len(parts)} of {FOLDS} folds, {sum(p['seconds'].get('accuracy', 0) for p in parts):.0f} s"
            )
            show_accuracy(parts)
    say("\n== In short (deployed over learned, units left out)")
    for name in names:
        if parts := read_parts(out, name, "accuracy"):
            verdict(name, parts)
        if parts := read_parts(out, name, "sensor"):
            show_sensor(name, parts)


def show_accuracy(parts: Sequence[Mapping[str, Any]]) -> None:
    """Print one population."""
    for part in parts:
        facts = part["facts"][part["deployed"]]
        known = [
            f"{k} {_short(v)}" for k, v in facts.items() if re.search(PROOFS, k) and not isinstance(v, (Mapping, list))
        ]
        say(f"fold {part['fold']}: deployed {part['deployed']}, {', '.join(known)}")
    conditions, hidden = conditions_of(parts), hidden_of(parts)
    say(f"{'deployed over learned':58s} {'mean':>7s} {'95 %':>7s} {'worst':>7s}")
    for condition, channel in product(conditions, hidden):
        for what in ("error_percent", "start_percent", "rest_percent"):
            own, other = (errors(parts, o, condition, channel, what) for o in ("deployed", LEARNED))
            text = f"  {condition}, {channel}{'' if what == 'error_percent' else ', ' + what.split('_')[0]}"
            say(ratio(own, other, text) + f"   {np.mean([*own.values()]):.4g} / {np.mean([*other.values()]):.4g} %")
    say(
        f"{f'{conditions[0]}, mean over units (worst)':28s}"
        + "".join(f"{f'{c}: % / open loop / learned':>46s}" for c in hidden)
    )
    for observer in dict.fromkeys(r["observer"] for p in parts for r in p["rows"]):
        cells = []
        for channel in hidden:
            own = errors(parts, observer, conditions[0], channel)
            others = [errors(parts, o, conditions[0], channel) for o in (open_loop_of(observer), LEARNED)]
            found = [paired(own, other) for other in others]
            ratios = [f"{v.mean():7.3f} ({v.max():6.3f})" if len(v) else f"{'-':>16s}" for v in found]
            cells.append(f"{np.mean([*own.values()]):10.4g}  " + " ".join(ratios))
        say(f"  {observer:26s}" + "  ".join(cells))
    if _has_truth(parts):
        for observer in ("deployed", LEARNED):
            show_truth(parts, conditions[0], observer, "true_", observer)
        show_truth(parts, conditions[0], LEARNED, "recorded_true_", "as recorded")
    for condition in conditions:
        shares = [share for p in parts for _, c, share in p["at_limit"] if c == condition]
        if max(shares) > REACHED:
            say(
                f"  at the current's limit, {condition}: {100 * np.mean(shares):.1f} % of samples, {100 * max(shares):.1f} % of the worst episode"
            )


def show_truth(parts: Sequence[Mapping[str, Any]], condition: str, observer: str, prefix: str, title: str) -> None:
    """Print error and lag against the true velocity."""
    error, lag = (
        np.mean([*errors(parts, observer, condition, "velocity", f"{prefix}{what}").values()])
        for what in ("error_percent", "lag_s")
    )
    say(f"  true velocity, {title}: error {error:.4g} %, lag {1e3 * lag:.3f} ms")


def conditions_of(parts: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the conditions, the one that was identified on first."""
    return sorted({r["condition"] for p in parts for r in p["rows"]}, key=lambda c: c != HOME)


def hidden_of(parts: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the states that are not measured."""
    return [c for c in dict.fromkeys(r["channel"] for r in parts[0]["rows"]) if c != "position"]


def at_the_limit(parts: Sequence[Mapping[str, Any]], condition: str) -> set[str]:
    """Return the units whose current reaches its limit in a condition."""
    return {f"{p['fold']}/{u}" for p in parts for u, c, share in p["at_limit"] if c == condition and share > REACHED}


def open_loop_of(observer: str) -> str:
    """Return the open loop of the same model."""
    return f"{observer.split('/')[0]}/open_loop"


def verdict(name: str, parts: Sequence[Mapping[str, Any]]) -> None:
    """Print what is asked of a population, what was found, and whether it is met."""
    conditions, hidden, short, limited = conditions_of(parts), hidden_of(parts), ":cut" in name, name.endswith(LIMITED)

    deployed = [p["facts"][p["deployed"]] for p in parts]
    made = ", ".join(dict.fromkeys(p["deployed"] for p in parts))
    proofs = [sum(f.get(key) is True for f in deployed) for key in ("relift_certified", "set_certified")]
    say(
        f"  {name:24s} deployed {made}; certified as it runs {proofs[0]}, for the set of signals {proofs[1]} of {len(parts)}"
    )
    for observer in dict.fromkeys(p["deployed"] for p in parts):
        bounds(name, observer, parts)
    for condition, channel in product(conditions, hidden):
        values = paired(*(errors(parts, o, condition, channel) for o in ("deployed", LEARNED)))
        what = f"{channel}, {condition}"
        if not len(values):
            continue
        if channel == "current" and (reached := at_the_limit(parts, condition)):
            own, other = (errors(parts, o, condition, channel) for o in ("deployed", LEARNED))
            at = paired({u: own[u] for u in own if u in reached}, other)
            line(name, f"{what}: worst of the units at the limit over learned", at.max(), 1.5, f"{len(at)} units")
        if limited:
            continue
        if short:
            line(name, f"{what}: mean over learned", values.mean(), 1.05, f"worst {values.max():.3f}")
        elif channel == "velocity":
            line(name, f"{what}: upper limit of the mean ratio", upper(values), 1.03, f"mean {values.mean():.3f}")
            line(name, f"{what}: worst unit", values.max(), 1.1)
        elif condition == conditions[0]:
            line(
                name,
                f"{what}: mean ratio",
                values.mean(),
                0.85,
                f"upper limit {upper(values):.3f}, worst {values.max():.3f}",
            )
    robust = [o for o in dict.fromkeys(r["observer"] for p in parts for r in p["rows"]) if "worst_case_h2" in o]
    for channel, most in (("velocity", 0.35), ("current", 0.85)) if not short and not limited else ():
        found = {
            o: paired(*(errors(parts, x, conditions[0], channel) for x in (o, open_loop_of(o)))).mean() for o in robust
        }
        if found:
            best = min(found, key=lambda o: found[o])
            bounds(name, best, parts)
            line(name, f"{channel}: best worst-case H2 over open loop", found[best], most, best)


def bounds(name: str, observer: str, parts: Sequence[Mapping[str, Any]]) -> None:
    """Print the bound for recorded signals over the errors of units left out, least and largest, where there is one."""
    ratios = []
    for part in parts:
        bound = part["facts"].get(observer, {}).get("set_bound_percent", {})
        rows = [r for r in part["rows"] if r["observer"] == observer and bound.get(r["channel"]) and r["error_percent"]]
        ratios += [bound[r["channel"]] / r["error_percent"] for r in rows]
    if ratios:
        line(name, f"{observer}: bound over error, largest", max(ratios), 3.0, f"least {min(ratios):.3f}")


def show_sensor(name: str, parts: Sequence[Mapping[str, Any]]) -> None:
    """Print errors of observers that were told of the sensor over those of observers that were not, and over the best rival that was told."""
    asked = {"noise": (0.5, 0.8), "late": (0.5, 0.8), "dropout": (1.0, 1.05), "coarse": (1.0, 1.05)}
    condition = conditions_of(parts)[0]
    rivals = dict.fromkeys(
        r["observer"]
        for p in parts
        for r in p["rows"]
        if r["observer"].endswith(("open_loop", "kalman_tuned", LEARNED))
    )
    for case, channel in product(dict.fromkeys(r["case"] for p in parts for r in p["rows"]), hidden_of(parts)):
        told, untold = (mean_error(parts, "deployed", condition, channel, case=case, told=t) for t in (True, False))
        means = {o: mean_error(parts, o, condition, channel, case=case, told=True) for o in rivals}
        best, what = min(means, key=lambda o: means[o]), f"{case}, {channel}: told {told:.4g} %"
        line(name, f"{what} over untold", told / untold, asked[case][0], f"{parts[0]['deployed'][case]}")
        line(name, f"{what} over best rival", told / means[best], asked[case][1], best)


def mean_error(parts: Sequence[Mapping[str, Any]], observer: str, condition: str, channel: str, **case: Any) -> float:
    """Return an observer's error, mean over the units."""
    return float(np.mean([*errors(parts, observer, condition, channel, **case).values()]))


def line(name: str, what: str, found: float, most: float, note: str = "") -> None:
    """Print what is asked, what was found, and whether it is met."""
    say(
        f"  {name:24s} {what:56s} {found:8.3f}   asked {most:g} [{'met' if found <= most * (1 + 1e-9) else 'MISSED'}] {note}"
    )


def _has_truth(parts: Sequence[Mapping[str, Any]]) -> bool:
    return any("true_error_percent" in r for r in parts[0]["rows"])


def _short(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def say(text: str) -> None:
    """Print at once."""
    sys.stdout.write(text + "\n")
    sys.stdout.flush()
