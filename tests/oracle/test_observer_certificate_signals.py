"""Bounds on errors for signals of known band energies, against responses on dense grids and machines that run."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from batches import batch_of
from scipy.linalg import block_diag
from scipy.signal import lfilter

from kros.core.lti import StateSpace, gain
from kros.lifting import Lifting
from kros.observer import Observer, Runtime, Seen, relift_certificate, run_observer
from kros.observer.certificate import majorants as majorants_of
from kros.observer.certificate.majorants import energy, majorants
from kros.observer.certificate.signals import signal_bound
from kros.synthesis import Injection
from kros.synthesis.worst_case.arcs import Enclosure
from kros.uncertainty.band_energies import band_edges

DT, N = 0.01, 600


def resonant(rng: np.random.Generator, n: int = 5, p: int = 2, m: int = 3, radius: float = 0.995) -> StateSpace:
    A = rng.standard_normal((n, n))
    return StateSpace(
        A * radius / np.abs(np.linalg.eigvals(A)).max(),
        rng.standard_normal((n, m)),
        rng.standard_normal((p, n)),
        rng.standard_normal((p, m)),
        DT,
    )


@pytest.mark.parametrize("seed", range(3))
def test_responses_on_arcs_are_as_close_to_their_segments_as_is_said(seed: int) -> None:
    rng = np.random.default_rng(seed)
    system = resonant(rng)
    theta = np.concatenate([np.linspace(0.05, 3.1, 40), np.abs(np.angle(np.linalg.eigvals(system.A)))])
    half = 10.0 ** rng.uniform(-4, -2, len(theta))
    ends, distance = Enclosure(system).segments(theta, half)
    closest = 0.0
    for at, h, (first, last), allowed in zip(theta, half, ends, distance, strict=True):
        along = np.linspace(-1, 1, 21)
        T = system.frequency_response((at + h * along) / (2 * np.pi * DT))
        # Of points at the same height of the arc, which is where the distance is said.
        share = (1 + np.sin(h * along) / np.sin(h))[:, None, None] / 2
        far = np.abs(T - (1 - share) * first - share * last)
        assert (far <= allowed).all()
        closest = max(closest, float((far / allowed).max()))
    assert closest > 0.5


@pytest.mark.parametrize("seed", range(3))
def test_majorants_are_above_the_response_at_every_frequency(seed: int) -> None:
    rng = np.random.default_rng(seed)
    system, edges = resonant(rng), band_edges(400, 20)
    F = rng.standard_normal((len(edges) - 1, 3, 2)) + 1j * rng.standard_normal((len(edges) - 1, 3, 2))  # of rank two
    weight = F @ F.conj().swapaxes(1, 2) * np.outer([1, 1e-3, 1e2], [1, 1e-3, 1e2])
    M = majorants(system, edges, weight)
    poles = np.abs(np.angle(np.linalg.eigvals(system.A)))
    theta = np.unique(
        np.concatenate(
            [
                np.linspace(0, np.pi, 8000),
                edges,
                *[np.clip(p + np.linspace(-0.02, 0.02, 2000), 0, np.pi) for p in poles],
            ]
        )
    )
    T = system.frequency_response(theta / (2 * np.pi * DT))
    for b in range(len(edges) - 1):
        rows = T[(theta >= edges[b]) & (theta <= edges[b + 1])]
        size = np.sqrt(np.diagonal(M[:, b], axis1=1, axis2=2).real)
        for j in range(2):
            height = np.einsum(
                "ki,ij,kj->k",
                rows[:, j] / size[j],
                np.linalg.inv(M[j, b] / np.outer(size[j], size[j])),
                (rows[:, j] / size[j]).conj(),
            ).real
            assert 0.5 < height.max() <= 1 + 1e-6  # on the edge: nothing more could be taken away at once


def test_majorants_of_a_constant_are_its_square() -> None:
    system = StateSpace(np.zeros((0, 0)), np.zeros((0, 2)), np.zeros((1, 0)), np.array([[3.0, -4.0]]), DT)
    weight = np.broadcast_to(np.array([[2.0, 0.5], [0.5, 1.0]]), (4, 2, 2))
    found = energy(majorants(system, np.linspace(0, np.pi, 5), weight), weight)
    assert found == pytest.approx(4 * (18 - 12 + 16), rel=1e-4)


def observer(functions: tuple[str, ...] = (), **runtime: object) -> Observer:
    rng, p = np.random.default_rng(3), len(functions)
    lifting = Lifting(("a", "b", "c"), functions, inputs=("u",))
    A = np.vstack(
        [
            np.hstack([0.7 * np.linalg.qr(rng.standard_normal((3, 3)))[0], 0.02 * rng.standard_normal((3, p))]),
            np.zeros((p, 3 + p)),
        ]
    )
    D = np.vstack([0.1 * rng.standard_normal((3, 1)), np.zeros((p, 1))])
    B = np.vstack([rng.standard_normal((3, 1)), np.zeros((p, 1))])
    return Observer("o", lifting, A, B, (0,), ("u",), gain(D, DT), Injection.STATE, DT, runtime=Runtime(**runtime))  # type: ignore[arg-type]


def recordings(seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    x = 0.3 * np.tanh(np.cumsum(0.1 * rng.standard_normal((N, 6, 3)), axis=0) + rng.standard_normal((6, 3)))
    return x, rng.standard_normal((N, 6, 1))


CASES = {
    "linear": ((), {}, 1.5),
    "slopes": (("0.3*sin(3*a)", "0.2*cos(2*b)"), {}, 1.5),
    "history": (("b[-2]", "0.2*sin(a[-1])"), {}, 1.5),
    "late": (("0.3*sin(3*a)",), {"delay": 2}, 1.5),
    "limits": ((), {"upper": np.array([np.inf, 0.35, np.inf])}, 20.0),
}


@pytest.mark.parametrize("noise", [0.0, 0.02])
@pytest.mark.parametrize("case", CASES)
def test_bounds_hold_for_every_unit_and_are_close(case: str, noise: float) -> None:
    functions, runtime, close = CASES[case]
    o, (x, u) = observer(functions, **runtime), recordings()
    delay = o.runtime.delay
    y = x[np.maximum(np.arange(N) - delay, 0)] + noise * np.random.default_rng(1).standard_normal(x.shape)
    batch = batch_of(x, u, DT, units=["1", "1", "2", "2", "3", "3"])
    batch = replace(batch, shown=y) if noise or delay else batch
    found = signal_bound(relift_certificate(o), o, batch)
    assert found.certified, found.reason
    assert found.errors.shape == (3, 3)
    assert ((found.ratios >= 1) & (found.ratios <= close)).all()
    assert (found.cover >= found.bounds.max(axis=0) * (1 - 1e-9) - 1e-9).all() or case == "limits"
    assert (found.cover <= 3 * found.bounds.max(axis=0)).all()


@pytest.mark.parametrize("case", ["linear", "slopes"])
def test_bounds_hold_for_other_signals_of_the_same_energies(case: str) -> None:
    """All-pass filters change the course of a residual and none of its energies; a machine is driven by what comes out, for longer."""
    o, (x, u) = observer(CASES[case][0]), recordings()
    found = signal_bound(relift_certificate(o), o, batch_of(x, u, DT, units=[str(i) for i in range(6)]))
    estimates = run_observer(o, x[..., :1], u)
    lift, A, B = o.lifting, o.A[:3], o.B[:3]
    omega = x[1:] - lift.lift(x[:-1]) @ A.T - u[:-1] @ B.T
    signal = np.concatenate([(x[0] - estimates[0])[None], omega, np.zeros((200, 6, 3))])
    more = np.concatenate([u, np.zeros((201, 6, 1))])
    largest = np.zeros((6, 3))
    for a in (-0.9, -0.5, 0.0, 0.5, 0.9):
        w = lfilter([a, 1.0], [1.0, a], signal, axis=0)
        assert np.sum(w[-1] ** 2) < 1e-12
        state = [np.concatenate([x[0, :, :1], w[0, :, 1:]], axis=-1)]
        for k in range(len(w) - 1):
            state.append(lift.lift(state[-1]) @ A.T + more[k] @ B.T + w[k + 1])
        truth = np.array(state)
        error = truth - run_observer(o, truth[..., :1], more[: len(truth)])
        largest = np.maximum(largest, np.sqrt(np.sum(error**2, axis=0) / N))
    assert (largest <= found.bounds).all()
    assert (largest > 0.5 * found.bounds).all()


def test_recordings_may_be_beyond_limits_by_their_noise() -> None:
    x, u = recordings()
    batch = batch_of(x, u, DT, units=["1", "1", "2", "2", "3", "3"])
    free, limited = observer(), observer((), upper=np.array([np.inf, 0.25, np.inf]))
    bounds = [signal_bound(relift_certificate(o), o, batch) for o in (free, limited)]
    assert not bounds[1].outside
    assert ((bounds[1].ratios >= 1) & (bounds[1].ratios < 20)).all()
    beyond = np.sqrt(np.mean(np.maximum(x[..., 1] - 0.25, 0) ** 2))
    # estimates are cut off, and nothing else changes but the states that stand for the true ones
    assert (bounds[1].cover <= bounds[0].cover + 4 * beyond).all()


def test_what_leaves_the_assumptions_has_no_bound() -> None:
    x, u = recordings()
    batch = batch_of(x, u, DT, units=["1", "1", "2", "2", "3", "3"])
    refuses = replace(
        observer(), seen=Seen(np.array([float(np.sort(np.abs(x[..., 0]).max(axis=0))[-2]) / 1.5]), np.array([9.0]))
    )
    found = signal_bound(relift_certificate(refuses), refuses, batch)
    assert len(found.outside) == 1
    assert found.facts((0,))["set_outside"] == list(found.outside)
    out = np.array([unit in found.outside for unit in found.units])
    assert np.isinf(found.bounds[out]).all()
    assert (found.bounds >= found.errors).all()
    assert np.isfinite(found.bounds[~out]).all()
    grows = replace(observer(), A=1.5 * observer().A)
    found = signal_bound(relift_certificate(grows), grows, batch)
    assert not found.certified
    assert found.reason
    assert set(found.percent().values()) == {None}


@pytest.mark.parametrize("gap", [0.5, 1e-9])
def test_a_search_over_arcs_ends_at_its_cap(gap, monkeypatch):
    """Sharp resonances need more arcs than there may be: there is no majorant, where a wider one is enclosed."""
    A = block_diag(
        *((1 - gap) * np.array([[np.cos(w), np.sin(w)], [-np.sin(w), np.cos(w)]]) for w in (0.3, 1.0, 1.7, 2.4))
    )
    system = StateSpace(A, np.ones((8, 1)), np.eye(8)[:1], np.zeros((1, 1)), 1.0)
    tried = []
    segments = majorants_of.Enclosure.segments
    monkeypatch.setattr(majorants_of, "_MOST_ARCS", 100)
    monkeypatch.setattr(majorants_of, "_ARCS", 50)
    monkeypatch.setattr(
        majorants_of.Enclosure, "segments", lambda self, *arcs: tried.append(len(arcs[0])) or segments(self, *arcs)
    )
    found = majorants_of.majorants(system, np.linspace(0, np.pi, 5), np.ones((4, 1, 1)))
    assert (found is None) == (gap < 1e-6), tried
    assert sum(tried) <= 100, tried
