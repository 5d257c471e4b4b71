r"""Full weights: diagonal filters in frames that turn with the residuals, for a full perturbation.

    W_L = A^-1 F_L,   W_R = F_R B^-1,   sigma_max(W_L^-1 E_k W_R^-1) <= 1

F_L, F_R are the diagonal weights of `A E_k B` (`weights`), A and B the multipliers of `full_multipliers`, with determinants of one: the mean log
singular values of W_L and W_R are those of the filters. The diagonal weights of the residuals themselves are one candidate, so that nothing is
lost where no frame helps: frames are used when the weights, as certified, have less volume.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.errors import ConfigError, KrosError
from ...core.lti import StateSpace, gain
from ..fits.magnitude import invert
from .certificate import Method
from .check import Checks, Residuals
from .cover import Cover, Structure
from .full_multipliers import Frames, best_frames, with_floor
from .pencils import ResidualSystems
from .weight import Weight, fit_weight, overbound_db, overbound_entry_db, scaled

Array = npt.NDArray[Any]

_LOG = logging.getLogger(__name__)
_MARGIN = 1e-9
_WORTH_DB = 0.1  # a frame that promises less is not fitted
_NEPER_DB = 20 * np.log10(np.e)


@dataclass(frozen=True, eq=False)
class FullWeight(Weight):
    """Weights `left = left_frame F_L`, `right = F_R right_frame` with diagonal F, sound for full perturbations.

    Orders and magnitudes are those of F_L and F_R; so is the cover that comes with it.

    Parameters
    ----------
    left_frame, right_frame : StateSpace
        Stable with stable inverses, of determinant plus or minus one at every frequency.
    saved_db : float, dB
        By how much `mean log sigma(W_L) + mean log sigma(W_R)`, averaged over the grid, is below that of diagonal weights fitted alike; zero
        where these are returned.
    """

    left_frame: StateSpace | None = None
    right_frame: StateSpace | None = None
    saved_db: float = 0.0

    def magnitudes(self, freqs_hz: npt.ArrayLike) -> Cover:
        """Return the magnitudes of the diagonals of F_L and F_R."""
        left, right, before, after = (s.frequency_response(freqs_hz) for s in (self.left, self.right, *self.frames))
        left, right = np.linalg.solve(before, left), np.swapaxes(np.linalg.solve(np.swapaxes(after, 1, 2), np.swapaxes(right, 1, 2)), 1, 2)
        return Cover(*(np.abs(np.einsum("fii->fi", x)) for x in (left, right)))

    def matrix(self) -> StateSpace:
        """Return the p' by m' system that bounds every entry of the residuals, where the frames do not turn.

        Raises
        ------
        ConfigError
            When they do: rows of the weights then mix entries.
        """
        if any(frame.n_states or not np.array_equal(frame.D, np.eye(frame.n_outputs)) for frame in self.frames):
            raise ConfigError(
                "Full weights: in turned frames they bound no single entries of the residuals; ask for structure 'diagonal' or 'entrywise'."
            )
        return super().matrix()

    @property
    def frames(self) -> tuple[StateSpace, StateSpace]:
        """Left and right frame."""
        assert self.left_frame is not None
        assert self.right_frame is not None
        return self.left_frame, self.right_frame

    def mapped(self, change: Callable[[StateSpace], StateSpace]) -> FullWeight:
        """Return the weight with all its systems changed."""
        before, after = (change(s) for s in self.frames)
        return replace(self, left=change(self.left), right=change(self.right), left_frame=before, right_frame=after)


def fit_full(
    residuals: Residuals, freqs_hz: Array, sample_period_s: float, *, systems: ResidualSystems | None = None, **options: Any
) -> tuple[FullWeight, Cover]:
    """Fit full weights.

    Parameters
    ----------
    residuals, freqs_hz, sample_period_s, systems, **options
        As of `fit_weight`; the largest order is that of the filters.

    Returns
    -------
    FullWeight
    Cover
        The optimal diagonal cover in the frames.
    """
    E = residuals(freqs_hz)
    diagonal, cover = _filters(residuals, freqs_hz, sample_period_s, systems=systems, **options)
    p, m = E.shape[2:]
    same = tuple(gain(np.eye(k), sample_period_s) for k in (p, m))
    if (p, m) == (1, 1) or not (cover.left.any(axis=1) & (freqs_hz > 0)).any():
        return _full(diagonal, *same), cover
    *turned, still = best_frames(E, freqs_hz, sample_period_s)
    checks = Checks(options.get("density", 10), options.get("also_hz"), systems, options.get("sampled", False))
    for frames in turned:
        if (still.cost - frames.cost) * _NEPER_DB < _WORTH_DB:
            continue
        weight, of_frames = _in_frames(frames, residuals, freqs_hz, checks, sample_period_s, options)
        saved = volume_db(diagonal, freqs_hz) - volume_db(weight, freqs_hz)
        if saved > 0:
            return replace(weight, saved_db=saved), of_frames
    return _full(diagonal, *same), cover


def volume_db(weight: Weight, freqs_hz: Array) -> float:
    """Return `mean log sigma(W_L) + mean log sigma(W_R)`, averaged over frequency, dB: the volume of `W_L Delta W_R` per dimension."""
    return float(weight.magnitudes(freqs_hz).cost_db().mean())


def _in_frames(
    frames: Frames, residuals: Residuals, freqs_hz: Array, checks: Checks, dt: float, options: dict[str, Any]
) -> tuple[FullWeight, Cover]:
    """Fit the filters in frames, return the weights of the residuals themselves and certify them."""
    filters, cover = _filters(lambda f: frames.of(with_floor(residuals(f)), f), freqs_hz, dt, **options)
    before, after = invert(frames.left), invert(frames.right)
    weight = replace(_full(filters, before, after), left=before @ filters.left, right=filters.right @ after)

    def ratio(at_hz: Array) -> Array:
        used = filters.magnitudes(at_hz)
        turned = frames.of(residuals(at_hz), at_hz) / used.left[:, :, None] / used.right[:, None, :]
        return np.asarray(np.linalg.norm(turned, 2, axis=(-2, -1)))

    dense = checks.claimed(freqs_hz, dt)
    proof = checks.proof(ratio, dense, weight.left, weight.right)
    bound = proof.peak * (1 + proof.margin) if proof.method is Method.LEVEL_SETS else proof.peak
    lift = bound * (1 + _MARGIN)
    lifted = scaled(weight, lift)
    on_grid = float(np.linalg.norm(_between(lifted, residuals(dense), dense), 2, axis=(-2, -1)).max())
    if on_grid > 1:  # rounding of the product of frames and filters
        lifted, on_grid = scaled(lifted, on_grid * (1 + _MARGIN)), 1 / (1 + _MARGIN)
    assert isinstance(lifted, FullWeight)
    excess = overbound_db(lifted, freqs_hz, cover)
    return replace(
        lifted,
        cover_max=on_grid,
        method=proof.method,
        remaining_margin=1 - max(bound / lift, on_grid),
        overbound_db_max=excess,
        overbound_entry_db=overbound_entry_db(lifted, freqs_hz, cover),
        within_tolerance=excess <= options.get("tolerance_db", 1.0),
    ), cover


def _filters(residuals: Residuals, freqs_hz: Array, dt: float, **options: Any) -> tuple[Weight, Cover]:
    """Diagonal weights, or scalar ones where these cannot be fitted."""
    try:
        return fit_weight(residuals, freqs_hz, dt, structure=Structure.DIAGONAL, **options)
    except KrosError as error:
        _LOG.info("Full weights: equal filters are taken in one of the frames (%s)", error)
        return fit_weight(residuals, freqs_hz, dt, structure=Structure.SCALAR, **options)


def _between(weight: Weight, E: Array, freqs_hz: Array) -> Array:
    """`W_L^-1 E_k W_R^-1` of the systems as returned."""
    left, right = weight.left.frequency_response(freqs_hz), weight.right.frequency_response(freqs_hz)
    return np.asarray(np.linalg.solve(left, E) @ np.linalg.inv(right))


def _full(weight: Weight, before: StateSpace, after: StateSpace) -> FullWeight:
    """Return diagonal weights as full ones between frames."""
    facts = {name: getattr(weight, name) for name in weight.__dataclass_fields__} | {"structure": Structure.FULL}
    return FullWeight(**facts, left_frame=before, right_frame=after)
