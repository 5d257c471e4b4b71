"""Limits found in recordings: those of simulated machines, as they are, and none where there is none."""

import numpy as np
import pytest

from kros.data import EpisodeKey
from kros.identify.flat_tops import ends_of, found_limit
from kros.identify.survey import survey
from kros.plants import PLANTS

T = np.arange(4000) * 1e-3


def swing(k, size=1.0):
    """A signal that rises and falls at its own pace in every episode, under inputs that never repeat."""
    rng = np.random.default_rng(k)
    return size * sum(rng.uniform(0.7, 1.3) * np.sin(2 * np.pi * f * T + rng.uniform(0, 6)) for f in (1.1, 2.3, 3.7))


def held(levels, samples):
    return np.repeat(levels, samples)[: len(T)]


def trapezoid(k, top):
    """Triangles cut off at a speed that is commanded; the pace differs."""
    return np.clip(1.5 * np.abs((T * (1 + 0.1 * k)) % 1 - 0.5) * 4 - 1.5, -top, top)


def lagged(u, pole=0.99):
    x = np.zeros(len(u))
    for i in range(1, len(u)):
        x[i] = pole * x[i - 1] + (1 - pole) * u[i - 1]
    return x


def noise(k, size=2e-3):
    return size * np.random.default_rng(100 + k).normal(size=len(T))


NO_LIMITS = {
    "a sine": lambda k: (np.sin(9 * T), np.cos(9 * T + k)),
    "a noisy sine": lambda k: (np.sin(9 * T) + noise(k), swing(k)),
    "a slow sine": lambda k: (np.sin(1.5 * T + k) + noise(k), swing(k)),
    "a coarse sine": lambda k: (np.rint(np.sin(9 * T) / 0.02) * 0.02, swing(k)),
    "a swing": lambda k: (swing(k) + noise(k), swing(k)),
    "noise": lambda k: (noise(k), swing(k)),
    "levels": lambda k: (np.clip(np.rint(swing(k)), -1, 1), swing(k)),
    "a commanded plateau": lambda k: (trapezoid(k, 1.0) + noise(k), trapezoid(k, 1.0)),
    "a commanded plateau beside another input": lambda k: (
        trapezoid(k, 1.0) + noise(k),
        np.stack([trapezoid(k, 1.0), swing(k)], 1),
    ),
    "answers to two levels": lambda k: (
        lagged(held(np.random.default_rng(k).choice([-1.0, 1.0], 10), 400)),
        held(np.random.default_rng(k).choice([-1.0, 1.0], 10), 400),
    ),
    "answers to random levels": lambda k: (
        lagged(held(np.random.default_rng(k).uniform(-1, 1, 10), 400)) + noise(k),
        held(np.random.default_rng(k).uniform(-1, 1, 10), 400),
    ),
    "one unit goes further": lambda k: (np.clip(swing(k), -1 - 0.2 * (k == 2), 1 + 0.2 * (k == 3)), swing(k)),
    "a start at ambient": lambda k: (26 + np.maximum(0.0, (T - 0.2 - 0.01 * k)) * (1 + 0.1 * k), swing(k)),
    "another limit in every episode": lambda k: (np.clip(swing(k), -1 - 0.1 * k, 1 + 0.1 * k), swing(k)),
}
LIMITS = {
    "clipped": lambda k: (np.clip(swing(k), -1, 1), swing(k)),
    "clipped and noisy": lambda k: (np.clip(swing(k), -1, 1) + noise(k), swing(k)),
    "clipped and coarse": lambda k: (np.rint(np.clip(swing(k), -1, 1) / 0.01) * 0.01, swing(k)),
    "clipped in few units": lambda k: (np.clip(swing(k, 1.0 if k < 2 else 0.2), -1, 1) + noise(k), swing(k)),
}


def look(signal, episodes=6):
    pairs = [signal(k) for k in range(episodes)]
    inputs = [np.reshape(u, (len(T), -1)) for _, u in pairs]
    ends = [
        ends_of(EpisodeKey(str(k), "default", "0"), x, u)
        for k, ((x, _), u) in enumerate(zip(pairs, inputs, strict=True))
    ]
    return found_limit(ends, np.ptp(np.concatenate(inputs), axis=0))


@pytest.mark.parametrize("name", NO_LIMITS)
@pytest.mark.parametrize("size", [1.0, 1e6])
def test_what_has_no_limit_gets_none(name, size):
    assert look(lambda k: (size * NO_LIMITS[name](k)[0], NO_LIMITS[name](k)[1])) is None


@pytest.mark.parametrize("name", LIMITS)
@pytest.mark.parametrize("size", [1.0, 1e-6])
def test_a_limit_is_found_where_a_signal_was_cut_off(name, size):
    found = look(lambda k: (size * LIMITS[name](k)[0], LIMITS[name](k)[1]))
    np.testing.assert_allclose([found.lower, found.upper], [-size, size], rtol=2e-3)


def test_a_limit_of_one_side_is_one_of_one_side():
    found = look(lambda k: (np.minimum(swing(k), 1.0) + noise(k), swing(k)))
    assert found.lower is None
    assert found.upper == pytest.approx(1.0, rel=2e-3)


@pytest.mark.parametrize(
    ("plant", "options", "limit"),
    [
        ("harmonic-drive", {"seed": 404, "spread": 3.0, "n_units": 12, "n_episodes": 2, "seconds": 6.0}, 1.0),
        ("harmonic-drive", {"seed": 1, "n_units": 4, "n_episodes": 2, "seconds": 4.0}, None),
        ("dc-motor", {"seed": 0, "n_units": 4, "n_episodes": 4, "seconds": 4.0}, 8.0),
        ("pendulum", {"seed": 0, "n_units": 4, "n_episodes": 4, "seconds": 8.0}, None),
    ],
)
def test_limits_of_simulated_machines_are_found_and_no_others(plant, options, limit):
    _, facts = survey(PLANTS[plant](**options).simulate().population)
    found = {name: (own.lower, own.upper) for name, own in facts.limits.items()}
    assert list(found) == ([] if limit is None else ["current"])
    if limit is not None:
        np.testing.assert_allclose(found["current"], (-limit, limit), rtol=1e-3)
