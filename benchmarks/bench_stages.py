"""Each stage of kros beside other packages and the plainly written published algorithm, in one run, on the same problem.

A contestant's result is compared with that of kros before its time counts; where a slow one was given a share of the problem, its time is divided
by the share. Times are processor times: other work on the machine does not inflate them much. `make bench` writes docs/benchmarks.md from them.
"""

from __future__ import annotations

import logging
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import paper_slsqp
import plain
import problems
import pytest
from problems import DT, QUADRATIC

from kros.core import StateSpace, h2_norm, hinf_norm
from kros.core.frequency import log_grid
from kros.data import read
from kros.data.readers.motor_drive_raw import write_raw
from kros.identify import edmd, free_run
from kros.identify.factors import reduce_episode
from kros.observer import run_observer
from kros.synthesis import h2, hinf
from kros.synthesis.mixed_norms.mixed import by_inequalities
from kros.uncertainty import choose_nominal, fit_magnitude
from kros.uncertainty.weights.cover import optimal_cover

pytestmark = pytest.mark.filterwarnings("default")
FORM = "inverse_input_multiplicative"


@dataclass(frozen=True)
class Entry:
    """A contestant: what it does, which share of the problem, and how far its result may be from that of kros (NaN: not comparable, see `note`)."""

    run: Callable[[], Any]
    share: float = 1.0
    within: float = 1e-6
    note: str = ""


@dataclass(frozen=True)
class Stage:
    """One problem, by contestant; `result` makes numbers of what they return."""

    size: str
    entries: Mapping[str, Callable[[], Entry]]
    result: Callable[[Any], Any] = np.asarray


def lift(x: np.ndarray) -> np.ndarray:
    """Return three states with their products, one sample or many."""
    a, b, c = np.moveaxis(x, -1, 0)
    return np.stack([a, b, c, a * a, a * b, a * c, b * b, b * c, c * c], axis=-1)


def of_control(plant: Any) -> Any:
    """Return a generalized plant for python-control."""
    import control

    whole = plant.open_loop()
    return control.ss(whole.A, whole.B, whole.C, whole.D, *([plant.dt] if plant.dt else []))


def reading() -> Stage:
    root = Path(problems.__file__).parents[1] / "build" / "bench_raw"
    if not root.exists():
        write_raw(problems.raw_drives(8), root)
    files = sorted(root.rglob("*.csv"))

    def ours() -> Any:
        population = read(root, "motor-drive-raw")
        return [population.read(key) for key in population.episodes]

    def pandas() -> Any:
        import pandas as pd

        return [pd.read_csv(file).to_numpy() for file in files]

    note = "pandas parses numbers alone; kros also cuts the rest, removes the offset, aligns the targets and checks every sample"
    return Stage(
        "8 files of 20 000 rows",
        {"kros": lambda: Entry(ours), "pandas": lambda: Entry(pandas, within=np.nan, note=note)},
        len,
    )


def models() -> Stage:
    x, u = problems.recording(20_000)

    def ours() -> Any:
        found = edmd(reduce_episode(x, u, QUADRATIC).R, 9, 1.0)
        return np.hstack([found.A, found.B])

    def pykoop() -> Entry:
        from pykoop import Edmd, KoopmanPipeline, PolynomialLiftingFn, SplitPipeline

        def fit() -> Any:
            pipeline = KoopmanPipeline(
                [("p", SplitPipeline([("p", PolynomialLiftingFn(max_order=2, tolerance_db=0.0))], None))],
                Edmd(alpha=1.0),
            )
            return pipeline.fit(np.hstack([x, u]), n_inputs=2, episode_feature=False).regressor_.coef_.T

        return Entry(fit)

    others = {"pykoop": pykoop, "plain": lambda: Entry(lambda: plain.edmd(x, u, lift, 1.0))}
    return Stage("20 000 samples, 9 lifted states, 2 inputs", {"kros": lambda: Entry(ours), **others})


def predictions() -> Stage:
    x, u = problems.recording(500)
    rng = np.random.default_rng(1)
    x0, inputs = 0.1 * rng.normal(size=(200, 3)), rng.normal(size=(200, 500, 2))

    @cache
    def pipeline() -> Any:
        from pykoop import Edmd, KoopmanPipeline, PolynomialLiftingFn, SplitPipeline

        lifting = [("p", SplitPipeline([("p", PolynomialLiftingFn(max_order=2, tolerance_db=0.0))], None))]
        return KoopmanPipeline(lifting, Edmd(alpha=1e5)).fit(np.hstack([x, u]), n_inputs=2, episode_feature=False)

    found = edmd(reduce_episode(x, u, QUADRATIC).R, 9, 1e5)
    batch = [np.tile(M, (200, 1, 1)) for M in (found.A, found.B)]
    others = {
        "pykoop": lambda: Entry(
            lambda: [pipeline().predict_trajectory(x0[:1], inputs[0], episode_feature=False)], share=1 / 200
        ),
        "plain": lambda: Entry(
            lambda: [plain.free_run(found.A, found.B, lift, x0[i], inputs[i]) for i in range(4)], share=4 / 200
        ),
    }
    ours = Entry(lambda: free_run(*batch, QUADRATIC, {}, x0, inputs))  # type: ignore[call-arg]
    return Stage("200 episodes of 500 samples, 9 lifted states", {"kros": lambda: ours, **others})


def frequency_responses() -> Stage:
    units, freqs = problems.lags(38), log_grid(DT, 1000)

    def control() -> Entry:
        import control

        systems = [control.ss(units[i].A, units[i].B, units[i].C, units[i].D, DT) for i in range(38)]
        return Entry(
            lambda: [np.moveaxis(control.frequency_response(s, 2 * np.pi * freqs).complex, -1, 0) for s in systems]
        )

    others = {
        "python-control": control,
        "plain": lambda: Entry(lambda: [plain.response(units[i], freqs) for i in range(4)], share=4 / 38),
    }
    return Stage(
        "38 units, 4 × 2, 1000 frequencies", {"kros": lambda: Entry(lambda: units.frequency_response(freqs)), **others}
    )


def nominals() -> Stage:
    G = problems.responses(12, 200, outputs=2)

    def dkpy() -> Entry:
        import dkpy

        def largest(i: int) -> float:
            E = dkpy.compute_uncertainty_residual_response(
                G[i], np.delete(G, i, axis=0), {"inverse_multiplicative_input"}
            )
            return float(np.linalg.norm(E["inverse_multiplicative_input"], 2, axis=(-2, -1)).max())

        return Entry(lambda: min(map(largest, range(len(G)))))

    others = {"dkpy": dkpy, "plain": lambda: Entry(lambda: plain.peaks(G).min())}
    return Stage(
        "12 units, 2 × 2, 200 frequencies",
        {"kros": lambda: Entry(lambda: np.max(choose_nominal(G, FORM).bound)), **others},
    )


def covers() -> Stage:
    G = problems.responses(10, 20, outputs=2)
    nominal = choose_nominal(G, "additive").index
    E = np.delete(G, nominal, axis=0) - G[nominal]

    def ours() -> Any:
        cover = optimal_cover(E)
        return cover.left, cover.right

    def dkpy() -> Entry:
        import dkpy

        def fit() -> Any:
            sides = dkpy.compute_uncertainty_weight_response(E, "diagonal", "diagonal")
            return [np.abs(np.einsum("fii->fi", side)) for side in sides]

        return Entry(fit, within=1e-4)

    def largest(sides: Any) -> float:
        left, right = sides
        return float(np.linalg.norm(E / left[:, :, None] / right[:, None, :], 2, axis=(-2, -1)).max())

    return Stage("9 residuals, 2 × 2, 20 frequencies", {"kros": lambda: Entry(ours), "dkpy": dkpy}, largest)


def magnitudes() -> Stage:
    omega = np.geomspace(1e-2, 1e2, 100)
    s = 1j * omega
    magnitude = np.abs((s + 1) ** 2 / ((s + 0.1) * (s + 10)))

    def ours() -> Any:
        freqs = omega / (2 * np.pi)
        period = np.sqrt(10.0) / (np.pi * freqs[-1])  # of the bilinear map, which takes magnitudes to discrete time
        mapped = np.arctan(np.pi * period * freqs) / (np.pi * period)
        fitted = fit_magnitude(mapped, magnitude, period, max_order=2, tolerance_db=0.0)
        return np.abs(fitted.system.frequency_response(mapped)[:, 0, 0])

    def dkpy() -> Entry:
        import dkpy

        def fit() -> Any:
            return np.abs(
                dkpy.fit_uncertainty_weight(magnitude[:, None, None], omega, [2], weight=np.ones((100, 1)))(s)
            )

        return Entry(fit, within=2e-3)

    note = "sequential quadratic programming from one start ends away from the optimum"
    slsqp = Entry(
        lambda: np.abs(paper_slsqp.response(paper_slsqp.fit(omega, magnitude, 2), omega)), within=np.nan, note=note
    )
    # what it misses: the magnitude itself is a fit of this order
    return Stage(
        "100 frequencies, order 2",
        {"kros": lambda: Entry(ours), "dkpy": dkpy, "plain": lambda: slsqp},
        lambda f: np.squeeze(f) / magnitude,
    )


def systems_h2() -> Stage:
    plant = problems.plant(12)

    def control() -> Entry:
        import control

        system = of_control(plant)
        return Entry(lambda: control.h2syn(system, 2, 2))

    def cost(K: Any) -> float:
        K = getattr(K, "controller", K)
        return float(h2_norm(plant.close(StateSpace(K.A, K.B, K.C, K.D, 0.0))))

    others = {"python-control, slycot": control, "plain": lambda: Entry(lambda: plain.h2(plant))}
    return Stage("12 states, continuous", {"kros": lambda: Entry(lambda: h2(plant)), **others}, cost)


def systems_hinf() -> Stage:
    plant = problems.plant(8)

    def control() -> Entry:
        import control

        system = of_control(plant)
        return Entry(lambda: control.hinfsyn(system, 2, 2)[2], within=1e-3)

    def dkpy() -> Entry:
        import dkpy

        system = of_control(plant)
        return Entry(lambda: dkpy.HinfSynLmi().synthesize(system, 2, 2)[2], within=1e-2)

    ours = Entry(lambda: hinf(plant).hinf_norm)
    return Stage("8 states, continuous", {"kros": lambda: ours, "python-control, slycot": control, "dkpy": dkpy}, float)


def norms_hinf() -> Stage:
    plant = problems.plant(30, 1.0)
    system = plant.open_loop()

    def control() -> Entry:
        import control

        whole = of_control(plant)
        return Entry(lambda: control.linfnorm(whole)[0])

    return Stage(
        "30 states, discrete",
        {"kros": lambda: Entry(lambda: hinf_norm(system)), "python-control, slycot": control},
        float,
    )


def norms_h2() -> Stage:
    plant = problems.plant(30, 1.0)
    system = plant.open_loop()

    def control() -> Entry:
        import control

        whole = of_control(plant)
        return Entry(lambda: control.norm(whole, 2))

    return Stage(
        "30 states, discrete", {"kros": lambda: Entry(lambda: h2_norm(system)), "python-control": control}, float
    )


def mixed_norms() -> Stage:
    plant = problems.two_channels()
    note = "one Lyapunov matrix for both norms: its bound of the H2 norm"
    published = Entry(lambda: plain.mixed(plant), within=0.3, note=note)
    return Stage(
        "6 states, 5 × 5, discrete, constraint active",
        {"kros": lambda: Entry(lambda: by_inequalities(plant)), "plain": lambda: published},
        lambda found: float(getattr(found, "h2_norm", found)),
    )


def observers() -> Stage:
    o, rng = problems.observer(QUADRATIC, 4), np.random.default_rng(2)
    y, u = 0.1 * rng.normal(size=(2000, 100, 1)), 0.1 * rng.normal(size=(2000, 100, 2))
    one_by_one = Entry(lambda: [plain.observe(o, lift, y[:, i], u[:, i]) for i in range(2)], share=2 / 100)
    ours = Entry(lambda: np.moveaxis(run_observer(o, y, u), 1, 0))
    return Stage(
        "100 episodes of 2000 samples, 9 lifted states, filter of order 4",
        {"kros": lambda: ours, "plain": lambda: one_by_one},
    )


STAGES: dict[str, tuple[Callable[[], Stage], tuple[str, ...]]] = {
    "read: CSV files of drives": (reading, ("pandas",)),
    "identify: one model from an episode": (models, ("pykoop", "plain")),
    "identify: free runs of a model": (predictions, ("pykoop", "plain")),
    "quantify: frequency responses": (frequency_responses, ("python-control", "plain")),
    "quantify: the best nominal among all units": (nominals, ("dkpy", "plain")),
    "quantify: optimal cover of residuals": (covers, ("dkpy",)),
    "quantify: fit of a magnitude": (magnitudes, ("dkpy", "plain")),
    "synthesize: H2 controller": (systems_h2, ("python-control, slycot", "plain")),
    "synthesize: H-infinity optimum": (systems_hinf, ("python-control, slycot", "dkpy")),
    "synthesize: mixed H2/H-infinity controller": (mixed_norms, ("plain",)),
    "certify: H-infinity norm": (norms_hinf, ("python-control, slycot",)),
    "certify: H2 norm": (norms_h2, ("python-control",)),
    "evaluate: an observer on all episodes": (observers, ("plain",)),
}
MODULES = {"python-control": "control"}


@cache
def stage(name: str) -> Stage:
    return STAGES[name][0]()


@cache
def reference(name: str) -> Any:
    own = stage(name)
    return own.result(own.entries["kros"]().run())


@pytest.fixture(autouse=True)
def quiet() -> Iterator[None]:
    """Peers warn of what they do."""
    logging.disable(logging.WARNING)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield
    logging.disable(logging.NOTSET)


@pytest.mark.benchmark(timer=time.process_time)
@pytest.mark.parametrize(
    ("name", "by"), [(name, by) for name, (_, others) in STAGES.items() for by in ("kros", *others)]
)
def test_stage(benchmark: Any, name: str, by: str) -> None:
    for package in by.split(", "):
        if package not in ("kros", "plain"):
            pytest.importorskip(
                MODULES.get(package, package), reason=f"{package} is not installed, see benchmarks/README.md"
            )
    own = stage(name)
    entry = own.entries[by]()
    entry.run()  # imports and caches
    start = time.process_time()
    found = own.result(entry.run())
    seconds = time.process_time() - start
    deviation = np.nan
    if not np.isnan(entry.within):
        expected = reference(name)[: len(found)] if np.ndim(found) else reference(name)
        deviation = float(np.abs(found - expected).max() / np.abs(expected).max())
        assert deviation <= entry.within
    iterations = max(1, int(0.02 / max(seconds, 1e-6)))
    benchmark.group = name
    benchmark.extra_info |= {
        "by": by,
        "share": entry.share,
        "size": own.size,
        "deviation": deviation,
        "note": entry.note,
    }
    benchmark.pedantic(entry.run, rounds=int(np.clip(0.5 / max(seconds, 0.02), 3, 9)), iterations=iterations)
