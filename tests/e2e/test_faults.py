"""Every observer of a study gets over samples that cannot be true."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from kros.data.readers.parquet import read_parquet
from kros.identify import PhaseCalibration
from kros.observer import Observer, run_observer
from kros.observer.certificate.error import error_system
from kros.observer.screen import screened

AT, GOOD, SAMPLES = 1000, 2000, 5000


def test_what_a_study_hands_over_forgets_faults(demo: Path) -> None:
    """Within one percent of the estimate's RMS after 2000 good samples or five slowest time constants, whichever is longer."""
    facts = json.loads((demo / "population" / "facts.json").read_text())
    population = read_parquet(Path(demo, facts["recordings"]))
    n, key = len(population.states), population.episodes[0]
    values, largest = (
        population.read(key)[:SAMPLES],
        np.max([np.abs(population.read(k)).max(axis=0) for k in population.episodes], axis=0),
    )
    phase = PhaseCalibration.load(demo / "calibration").units[key.unit].phase_rad
    names = json.loads((demo / "observers" / "observers.json").read_text())["names"]
    late, missed = [], {}
    for name in names:
        observer = Observer.load(str(demo / "observers" / f"{name}.json"))
        assert observer.seen is not None
        measured = list(observer.measured)
        np.testing.assert_array_less(0.5 * largest[measured], observer.seen.measured)
        y, u = (np.repeat(v[:, None], 8, axis=1) for v in (values[:, measured], values[:, n:]))
        assert not screened(observer, y, u).status.any()  # nothing that was recorded is implausible
        u[AT, 1, 0], u[AT, 2], y[AT, 3], u[AT, 4, 0] = np.nan, -np.inf, 1e9, 1e9
        y[AT : AT + 100, 5], y[0, 6], u[0, 7] = -1e9, np.nan, np.nan
        found = run_observer(observer, y, u, {"phase": phase} if observer.lifting.parameters else None)[..., :n]
        size = np.sqrt(np.mean(found[:, :1] ** 2, axis=0))
        n_states = observer.lifting.n_states
        recovery = [0.0] if observer.bank is None else observer.bank.recovery
        A = error_system(observer).A if observer.bank is None else observer.A[n:n_states, n:n_states]
        radius = max(np.abs(np.linalg.eigvals(A)).max(), *recovery)
        wait = AT + 100 + max(GOOD, int(np.ceil(-5 / np.log(radius))) if radius < 1 else len(y))
        if wait < len(y):
            away = np.abs(found - found[:, :1])[wait:].max(axis=0) / size
            missed |= {(name, fault): share.max() for fault, share in enumerate(away) if not share.max() < 0.01}
        else:
            late.append(name)
        assert np.isfinite(found).all()
    assert not missed
    assert len(late) < len(names) / 2
