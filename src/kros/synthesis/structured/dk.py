r"""D-K iteration: a controller for a plant with structured uncertainty, in discrete or continuous time.

    K-step: hinf on the scaled plant  -->  mu of the closed loop, with its scalings D  -->  rational, stable, minimum-phase D  --+
      ^                                                                                                                         |
      +--------------------------------------- D_L P D_R^-1  <------------------------------------------------------------------+

The scalings need magnitudes only, because full blocks and scalars commute with any phase; the fit (`kros.uncertainty.fit_magnitude`) is stable and
minimum phase, so the scaled plant has the same stabilising controllers. Repeated scalars are scaled entry by entry, which is sound though not the best.
Neither step increases the bound, but together they need not find the best controller. Every controller is judged by the peak of its own mu,
the first one is plain `hinf`, and the best is returned.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.errors import ConfigError, KrosError
from ...core.frequency import log_grid
from ...core.lti import StateSpace, block_diagonal, gain
from ...core.norms import h2_norm, hinf_norm
from ...uncertainty.fits.magnitude import invert
from ..generalized_plant import GeneralizedPlant, split
from ..reduction.balancing import Balancing, gramian_root
from ..result import Status, Synthesis
from ..riccati.h2_optimal import stability_margin
from ..riccati.hinf_optimal import hinf
from .blocks import Block, Structure
from .bounds import MuBounds, mu_bounds
from .dk_scalings import rational_scalings

Array = npt.NDArray[Any]

log = logging.getLogger(__name__)
_POINTS = 100


@dataclass(frozen=True, eq=False)
class _Round:
    """A controller, its closed loop, and mu of that."""

    controller: StateSpace
    closed: StateSpace
    bounds: MuBounds
    grid: Array

    @classmethod
    def of(cls, plant: GeneralizedPlant, structure: Structure, controller: StateSpace, freqs_hz: Array) -> _Round:
        """Close the loop and judge it."""
        closed = plant.close(controller)
        return cls(controller, closed, mu_bounds(closed, structure.blocks, freqs_hz, prove=False), freqs_hz)

    def fitted(self, structure: Structure, max_order: int) -> tuple[StateSpace, StateSpace]:
        """Return scalings of z and of w for this closed loop."""
        return rational_scalings(self.closed, self.grid, self.bounds.freqs_hz, structure, max_order // 2).systems()


def dk_iteration(
    plant: GeneralizedPlant,
    blocks: Sequence[Block],
    *,
    iterations: int = 6,
    max_order: int = 4,
    tolerance: float = 1e-3,
    freqs_hz: npt.ArrayLike | None = None,
    start: Synthesis | None = None,
) -> Synthesis:
    r"""Return a controller with a small structured singular value from w to z, locally minimised.

    Robust performance is a full block from the performance outputs to the disturbances; the performance then holds for every perturbation of
    norm below one where the peak is at most one.

    Parameters
    ----------
    plant : GeneralizedPlant
        Discrete and regular, with the blocks' signals in z and w, in order.
    blocks : sequence of Block
    iterations : int
        K-steps after the first.
    max_order : int
        Of the scaling of one block, even; a full block of k signals takes k times as many states, in the plant twice.
    tolerance : float
        Two rounds that together lower the peak by less than this fraction end the iteration.
    freqs_hz : array_like, Hz, optional
        Where mu is computed first; default 100 logarithmic points over six decades below Nyquist. Peaks are refined in between.
    start : Synthesis, optional
        First controller in place of that of `hinf`.

    Returns
    -------
    Synthesis
        ``hinf_norm`` and ``h2_norm`` of the closed loop without scalings; the notes hold the peaks of mu of every round and the norm of
        the closed loop with the fitted scalings, which bounds mu at all frequencies and not on a grid alone.

    Raises
    ------
    ConfigError
        When an option is out of range or the plant is continuous.
    DimensionError
        When the blocks do not fit the plant.
    SynthesisError
        When the first K-step fails.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.synthesis import Block, GeneralizedPlant, dk_iteration
    >>> D11, D12 = np.zeros((2, 2)), [[0.0], [1.0]]
    >>> plant = GeneralizedPlant([[0.9]], [[1.0, 0.0]], [[1.0]], [[1.0], [0.0]], [[1.0]], D11, D12, [[0.0, 1.0]], [[0.0]], 1.0)
    >>> found = dk_iteration(plant, [Block.full(1), Block.full(1)], iterations=1, freqs_hz=np.geomspace(1e-3, 0.49, 20))
    >>> found.method, found.spectral_radius < 1
    ('dk_iteration', True)
    """
    if iterations < 0 or max_order < 0 or max_order % 2 or not tolerance > 0:
        raise ConfigError(
            f"D-K iteration: iterations = {iterations} and max_order = {max_order} should not be negative, the latter even, and tolerance = {tolerance} "
            "positive."
        )
    if plant.dt == 0:
        raise ConfigError("D-K iteration works in discrete time, found a continuous plant (dt = 0); sample it.")
    structure = Structure.of(blocks, plant.D11.shape)
    grid = log_grid(plant.dt, _POINTS) if freqs_hz is None else np.asarray(freqs_hz, dtype=float)
    began = time.perf_counter()
    first = start if start is not None else hinf(plant)
    rounds = [_Round.of(plant, structure, first.controller, grid)]
    for _ in range(iterations):
        try:
            scaled = scale(plant, *rounds[-1].fitted(structure, max_order))
            rounds.append(_Round.of(plant, structure, hinf(scaled, tolerance=1e-4).controller, grid))
        except KrosError as error:
            log.info("D-K iteration ends after %d rounds: %s", len(rounds), error)
            break
        peaks = [r.bounds.peak for r in rounds]
        if len(peaks) > 2 and min(peaks[-2:]) > min(peaks[:-2]) * (1 - tolerance):
            break
    best = int(np.argmin([r.bounds.peak for r in rounds]))
    left, right = rounds[best].fitted(structure, max_order)
    everywhere = hinf_norm(left @ rounds[best].closed @ invert(right))
    return _result(rounds, best, everywhere, time.perf_counter() - began)


def scale(plant: GeneralizedPlant, left: StateSpace, right: StateSpace) -> GeneralizedPlant:
    """Return the plant with ``z -> left z`` and ``w -> right^-1 w``; y and u stay as they are."""
    after, before = _pass_through(left, plant.sizes[4]), _pass_through(invert(right), plant.sizes[2])
    system = after @ plant.open_loop() @ before
    if system.is_stable():  # the Riccati equations lose digits in the coordinates of a series connection
        balancing = Balancing.of(gramian_root(system.A, system.B, system.dt), gramian_root(system.A.T, system.C.T, system.dt))
        system = balancing.truncated(system, system.n_states)
    return split(system, plant.sizes[1], plant.sizes[3])


def _pass_through(system: StateSpace, others: int) -> StateSpace:
    return block_diagonal([system, gain(np.eye(others), system.dt)]) if others else system


def _result(rounds: list[_Round], best: int, everywhere: float, seconds: float) -> Synthesis:
    closed, bounds = rounds[best].closed, rounds[best].bounds
    norm = hinf_norm(closed)
    peaks = ", ".join(f"{r.bounds.peak:.4g}" for r in rounds)
    return Synthesis(
        method="dk_iteration",
        controller=rounds[best].controller,
        status=Status.CERTIFIED,
        h2_norm=h2_norm(closed),
        hinf_norm=norm,
        spectral_radius=stability_margin(closed),
        solve_s=seconds,
        solver="riccati",
        notes=(
            f"peaks of mu by round: {peaks}; round {best} is returned",
            f"mu between {bounds.peak_lower:.6g} and {bounds.peak:.6g} at its peak, {bounds.peak_hz:.4g} Hz",
            f"mu at most {min(everywhere, norm):.6g} at every frequency, by the norm with fitted scalings",
        ),
    )
