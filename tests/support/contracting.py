"""Random observers of three states whose errors shrink, and recordings of machines that are none of their models."""

import numpy as np

from kros.core.lti import StateSpace
from kros.lifting import Lifting
from kros.observer import Observer, Runtime
from kros.synthesis import Injection

DT = 0.01


def contracting(functions=(), order=2, injection=Injection.STATE, *, seed=11, radius=0.85, lifted=0.03, **runtime):
    """Stable without correction too, so that a certificate exists whatever limits do."""
    rng, n, p = np.random.default_rng(seed), 3, len(functions)
    dynamics = [radius * np.linalg.qr(rng.standard_normal((n, n)))[0], lifted * rng.standard_normal((n, p))]
    width = 1 if injection is Injection.INPUT else n + p
    C, D = 0.05 * rng.standard_normal((width, order)), 0.1 * rng.standard_normal((width, 1))
    K = StateSpace(np.diag(np.linspace(0.2, 0.6, order)), rng.standard_normal((order, 1)), C, D, DT)
    A = np.vstack([np.hstack(dynamics), np.zeros((p, n + p))])
    B = np.vstack([rng.standard_normal((n, 1)), np.zeros((p, 1))])
    lifting = Lifting(("a", "b", "c"), functions, inputs=("u",))
    return Observer("o", lifting, A, B, (0,), ("u",), K, injection, DT, runtime=Runtime(**runtime))


def recordings(n_samples=300, size=0.3):
    """States and inputs of six machines, within a size."""
    rng = np.random.default_rng(0)
    x = np.cumsum(0.1 * rng.standard_normal((n_samples, 6, 3)), axis=0) + rng.standard_normal((6, 3))
    return size * np.tanh(x), rng.standard_normal((n_samples, 6, 1))
