"""How often the outlier scores flag a badly assembled drive, and how often a good one.

    python benchmarks/outlier_rates.py --seeds 200 260

Every population is 12 simulated drives and one with loose fasteners, at three severities (the same 12 drives each time), filed under the
same group, in both conditions. The drives are calibrated and identified as a study does it by default (Koopman models by extended dynamic
mode decomposition at one common regularisation) and scored. False alarms are counted with the planted drive among the 13 and without it.
Intervals are 95 % of Clopper and Pearson; units of one population share their cover, so the drives are not quite independent trials.

Factors of the recordings are kept in a folder, so that another form or rate takes seconds.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from kros.core.frequency import log_grid
from kros.core.lti import StateSpace
from kros.data.population import Population
from kros.identify import Factor, PhaseSpec, combine, edmd
from kros.identify.calibration import find_segments, resolve_branches, unit_phase
from kros.identify.edmd import smallest_stabilising_alpha
from kros.identify.factors import lifted_factor, reduce_episode
from kros.lifting import Lifting
from kros.plants import HarmonicDrivePopulation
from kros.uncertainty import Form, OutlierModel, score_outliers

Array = npt.NDArray[Any]
SEVERITIES = (0.5, 1.0, 2.0)
CONDITIONS = ("noload", "load")
STATES = ("position", "velocity", "current")
KOOPMAN = Lifting(STATES, ("sin(100*position + phase)",), ("phase",))
ALPHA_FACTOR = 4.0  # of a study
PERIOD_S = 1e-3
N_UNITS = 12


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs=2, default=[200, 260], metavar=("FIRST", "END"))
    parser.add_argument("--episodes", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=8.0)
    parser.add_argument("--rate", type=float, nargs="+", default=[1e-2])
    parser.add_argument("--forms", nargs="+", default=["additive"], choices=[f.value for f in Form])
    parser.add_argument("--kinds", nargs="+", default=["koopman"], choices=["koopman", "linear"])
    parser.add_argument("--cache", type=Path, default=Path("outlier_rates"))
    options = parser.parse_args()
    print("| models | form | condition | nominal rate | " + header() + " |")
    print("|---" * (7 + len(SEVERITIES)) + "|")
    factors = [factors_of(seed, options) for seed in range(*options.seeds)]
    for kind in options.kinds:
        for condition in CONDITIONS:
            populations = [responses(f, condition, kind) for f in factors]
            for form in options.forms:
                for rate in options.rate:
                    print(
                        f"| {kind} | {form} | {condition} | {100 * rate:g} % | "
                        + " | ".join(count(populations, form, rate))
                        + " |",
                        flush=True,
                    )


def header() -> str:
    """Return the columns that `count` fills."""
    alarms = "false alarms, 12 good | populations with one | false alarms beside a planted drive"
    detected = " | ".join(f"detected, severity {s:g}" for s in SEVERITIES)
    return f"{alarms} | {detected}"


def count(populations: list[dict[float, Array]], form: str, rate: float) -> list[str]:
    """Return false alarms without and with a planted drive, and detections at every severity."""
    good = np.array([[s.outlier for s in scored(p[0.0], form, rate).scores] for p in populations])
    bad = {s: [scored(p[s], form, rate).scores for p in populations] for s in SEVERITIES}
    beside = np.array([[s.outlier for s in scores[:-1]] for s in SEVERITIES for scores in bad[s]])
    detected = [share(np.array([scores[-1].outlier for scores in bad[s]])) for s in SEVERITIES]
    return [share(good), share(good.any(axis=1)), share(beside), *detected]


def scored(population: Array, form: str, rate: float) -> OutlierModel:
    """Score one population."""
    return score_outliers(population, grid(), form, false_alarm_rate=rate)


def share(hits: npt.NDArray[np.bool_]) -> str:
    """Return counts, percentage and interval."""
    from scipy.stats import beta

    k, n = int(hits.sum()), hits.size
    low = 0.0 if k == 0 else float(beta.ppf(0.025, k, n - k + 1))
    high = 1.0 if k == n else float(beta.ppf(0.975, k + 1, n - k))
    return f"{k}/{n}: {100 * k / n:.1f} % ({100 * low:.1f}–{100 * high:.1f})"


def grid() -> Array:
    """Return the frequencies of a study."""
    return log_grid(PERIOD_S, 1000)


def responses(factors: dict[str, Any], condition: str, kind: str) -> dict[float, Array]:
    """Return responses of the population without outlier (0) and with one of each severity."""
    lifting = KOOPMAN if kind == "koopman" else Lifting(STATES)
    found = {}
    for k, severity in enumerate((0.0, *SEVERITIES)):
        rows = [*range(N_UNITS)] if severity == 0 else [*range(N_UNITS), N_UNITS + k - 1]
        phase = {"phase": phases(factors, rows)}
        raw = Factor(
            factors[f"R_{condition}"][rows], factors[f"peak_{condition}"][rows], factors[f"n_{condition}"][rows]
        )
        both = {model: lifted_factor(raw, KOOPMAN, phase, model) for model in (KOOPMAN, Lifting(STATES))}
        alpha = ALPHA_FACTOR * smallest_stabilising_alpha([(f.R, model.n_lifted) for model, f in both.items()])
        factor, n = both[lifting], lifting.n_lifted
        matrices = edmd(factor.R, n, alpha)
        C, D = np.broadcast_to(np.eye(n), matrices.A.shape), np.zeros(matrices.B.shape)
        found[severity] = StateSpace(matrices.A, matrices.B, C, D, PERIOD_S).frequency_response(grid())
    return found


def phases(factors: dict[str, Any], rows: list[int]) -> Array:
    """Return the phases of some drives, on their common branch."""
    units = {str(r): factors["phases"][r] for r in rows}
    calibrated = resolve_branches(units, list(units), PhaseSpec()).units
    return np.array([calibrated[u].phase_rad for u in units])


def factors_of(seed: int, options: argparse.Namespace) -> dict[str, Any]:
    """Return factors and phases of 12 drives and the planted ones, from the cache where they are there."""
    from kros.identify.calibration import UnitPhase

    path = options.cache / f"seed{seed}_{options.episodes}x{options.seconds:g}s.npz"
    if not path.exists():
        options.cache.mkdir(parents=True, exist_ok=True)
        np.savez(path, **simulate(seed, options.episodes, options.seconds))
    with np.load(path) as stored:
        found = dict(stored)
    found["phases"] = [UnitPhase(*row[:3], int(row[3])) for row in found["phases"]]  # type: ignore[call-arg]
    return found


def simulate(seed: int, episodes: int, seconds: float) -> dict[str, Array]:
    """Simulate 12 drives and one planted drive of each severity, reduce all episodes, calibrate."""

    def of(n_units: int, severity: float | None) -> Population:
        settings = {} if severity is None else {"outlier": True, "outlier_severity": severity}
        return (
            HarmonicDrivePopulation(n_units=n_units, n_episodes=episodes, seconds=seconds, seed=seed, **settings)
            .simulate()
            .population
        )

    whole = of(N_UNITS, None)
    work = [(whole, u) for u in whole.unit_ids] + [(of(1, s), "000000") for s in SEVERITIES]
    found: dict[str, list[Any]] = {"phases": []} | {
        f"{name}_{c}": [] for name in ("R", "peak", "n") for c in CONDITIONS
    }
    for population, unit in work:
        spec = PhaseSpec()
        for condition in CONDITIONS:
            data = [population.read(key) for key in population.keys(unit, condition)]
            factor = combine(Factor.stack([reduce_episode(v[:, :3], v[:, 3:], KOOPMAN) for v in data]))
            for name, value in (("R", factor.R), ("peak", factor.peak), ("n", factor.n_samples)):
                found[f"{name}_{condition}"].append(value)
            if condition == "noload":
                segments = [
                    s for v in data for s in find_segments(v[:, 0], v[:, 4], v[:, 1], population.sample_period_s, spec)
                ]
                p = unit_phase(segments, unit, spec)
                found["phases"].append((p.phase_rad, p.lag_rad, p.concentration, p.n_segments))
    return {name: np.array(value) for name, value in found.items()}


if __name__ == "__main__":
    main()
