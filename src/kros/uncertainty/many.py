"""Weights of many units: fitted to those that decide, proven for all.

    residuals of all units, block by block --largest somewhere--> the units that decide --as for few units--> weights
    every block of units --certified against these weights--> units beyond them join the fit, or the weights are lifted

A cover is decided by the units that are largest at some frequency, in some entry or altogether: a few dozen however many there are. All others are only
asked whether they are covered, in blocks, so that memory does not grow with their number.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.lti import StateSpace
from ..core.small_matrices import sigma_max
from .forms import completion, misfit, residual
from .quantification import Bounded, Quantification
from .weights.certificate import Method, certify
from .weights.check import DENSITY, Checks, checking_grid
from .weights.cover import Cover, cover_ratio
from .weights.pencils import Part, ResidualSystems, peaks_hz
from .weights.weight import Weight

Array = npt.NDArray[Any]

MANY = 200  # units from which on those that decide are sought
_LOG = logging.getLogger(__name__)
_BLOCK = 50  # units at once
_ROUNDS = 3  # of fits, each with the units that were beyond the one before
_MARGIN = 1e-9


def is_many(asked: Quantification, n_units: int, time: Any) -> bool:
    """Tell whether units are so many that those that decide are sought; entrywise weights and continuous time have no such way."""
    return n_units > MANY and isinstance(time, float) and not asked.entrywise


def bound_many(asked: Quantification, base: StateSpace, units: StateSpace, freqs_hz: Array) -> Bounded:
    """Return weights for the residuals of many discrete units and for the remainder; sound for all, and optimal for those that decide."""
    many = _Many(asked, base, units, freqs_hz)
    rows = many.deciding()
    for last in (False,) * (_ROUNDS - 1) + (True,):
        found = many.fitted(rows)
        rest = {} if found.remainder is None else {Part.REMAINDER: found.remainder}
        proofs = many.proofs({Part.RESIDUAL: found.weight, **rest}, rows, certain=last)
        beyond = np.setdiff1d(np.concatenate([proof.beyond for proof in proofs.values()]), rows)
        if not beyond.size:
            break
        _LOG.debug("Weights of %d deciding units leave %d of %d outside", len(rows), len(beyond), len(many))
        rows = np.union1d(rows, beyond)
    _LOG.info("Weights: %d of %d units decide.", len(rows), len(many))
    return many.finished(found, proofs)


@dataclass(frozen=True, eq=False)
class _Proof:
    """What is known of all units and a weight: largest ratios by level sets or found, and on the grid; units beyond it."""

    bound: float
    on_grid: float
    method: Method
    beyond: Array

    @classmethod
    def together(cls, found: Sequence[_Proof]) -> _Proof:
        """Return what is known of all blocks."""
        sure = all(proof.method is Method.LEVEL_SETS for proof in found)
        method, beyond = Method.LEVEL_SETS if sure else Method.GRID, np.concatenate([proof.beyond for proof in found])
        return cls(max(proof.bound for proof in found), max(proof.on_grid for proof in found), method, beyond)


@dataclass(frozen=True, eq=False)
class _Many:
    asked: Quantification
    base: StateSpace
    units: StateSpace
    freqs_hz: Array

    def __len__(self) -> int:
        return int(self.units.batch_shape[0])

    def blocks(self) -> Iterator[slice]:
        """Yield slices of units."""
        return (slice(start, min(start + _BLOCK, len(self))) for start in range(0, len(self), _BLOCK))

    def deciding(self) -> Array:
        """Return the units that are the largest at some frequency: by singular value and by every entry, of the residual and of what it leaves out."""
        G, kept = self.base.frequency_response(self.freqs_hz), dict[int, tuple[Array, Array]]()
        for block in self.blocks():
            parts = completion(self.asked.form, G, self.units[block].frequency_response(self.freqs_hz))
            sizes = [
                size
                for E in parts
                for size in (sigma_max(E), *np.moveaxis(np.abs(E), (2, 3), (0, 1)).reshape(-1, *E.shape[:2]))
            ]
            for k, size in enumerate(sizes):
                largest, who = kept.get(k, (np.full(size.shape[1], -1.0), np.zeros(size.shape[1], int)))
                here, worst = size.max(axis=0), size.argmax(axis=0) + block.start
                kept[k] = np.where(here > largest, here, largest), np.where(here > largest, worst, who)
        return np.unique(np.concatenate([who for _, who in kept.values()]))

    def fitted(self, rows: Array) -> Bounded:
        """Return weights for some units."""
        few = self.units[rows]
        systems = ResidualSystems(self.asked.form, self.base, few)
        also = peaks_hz(systems, self._grid, self.base.dt)
        respond, all_of = self.base.frequency_response, few.frequency_response
        return self.asked.bound(respond, all_of, self.freqs_hz, self.base.dt, systems=systems, also_hz=also)

    @property
    def _grid(self) -> Array:
        return checking_grid(self.freqs_hz, self.base.dt, DENSITY, filled=True)

    def proofs(self, weights: Mapping[Part, Weight], rows: Array, certain: bool) -> dict[Part, _Proof]:
        """Compare weights with all units, as those of few units are."""
        found: dict[Part, list[_Proof]] = {part: [] for part in weights}
        proving = True
        for block in self.blocks():
            own = self.units[block]
            also = peaks_hz(ResidualSystems(self.asked.form, self.base, own), self._grid, self.base.dt)
            claimed = Checks(also).claimed(self.freqs_hz, self.base.dt)
            parts = completion(self.asked.form, self.base.frequency_response(claimed), own.frequency_response(claimed))
            for (part, weight), E in zip(weights.items(), parts, strict=False):
                known = _ratio(weight, E, claimed)
                proving &= certain or not np.setdiff1d(_beyond(known) + block.start, rows).size
                if proving:
                    found[part].append(self._proof(part, weight, own, claimed, known, block.start))
                else:
                    found[part].append(
                        _Proof(float(known.max()), float(known.max()), Method.GRID, _beyond(known) + block.start)
                    )
        return {part: _Proof.together(of_blocks) for part, of_blocks in found.items()}

    def _proof(self, part: Part, weight: Weight, units: StateSpace, claimed: Array, known: Array, start: int) -> _Proof:
        """Certify a weight against some units, from their ratios at claimed frequencies, shape (unit, frequency)."""

        def ratio(freqs_hz: Array) -> Array:
            if freqs_hz is claimed:
                return known
            return _ratio(
                weight,
                self._of(part, self.base.frequency_response(freqs_hz), units.frequency_response(freqs_hz)),
                freqs_hz,
            )

        found = certify(
            ratio, claimed, weight.left, weight.right, ResidualSystems(self.asked.form, self.base, units, part=part)
        )
        bound = found.peak * (1 + found.margin) if found.method is Method.LEVEL_SETS else found.peak
        beyond = _beyond(known)
        if bound > 1:
            beyond = np.append(beyond, ratio(np.array([found.freq_hz])).argmax())
        return _Proof(bound, float(known.max()), found.method, np.unique(beyond) + start)

    def finished(self, found: Bounded, proofs: Mapping[Part, _Proof]) -> Bounded:
        """Lift weights over what is beyond them, and say what holds for all units."""
        tolerance = self.asked.tolerance_db
        cover = self._sound(Part.RESIDUAL, found.cover)
        weight = _lifted(found.weight, proofs[Part.RESIDUAL]).measured(self.freqs_hz, cover, tolerance)
        ratio, bound = self._sizes()
        if found.remainder is None or found.remainder_cover is None:
            return replace(found, bound=bound, cover=cover, weight=weight, misfit=ratio)
        rest = self._sound(Part.REMAINDER, found.remainder_cover)
        remainder = _lifted(found.remainder, proofs[Part.REMAINDER])
        remainder = replace(
            remainder.measured(self.freqs_hz, rest, tolerance), within_tolerance=found.remainder.within_tolerance
        )
        return Bounded(bound, cover, weight, ratio, remainder, rest)

    def _sound(self, part: Part, cover: Cover) -> Cover:
        """Return a cover of the deciding units, raised at the frequencies at which others are beyond it."""
        G, largest = self.base.frequency_response(self.freqs_hz), np.ones(len(self.freqs_hz))
        for block in self.blocks():
            E = self._of(part, G, self.units[block].frequency_response(self.freqs_hz))
            largest = np.maximum(largest, cover_ratio(E, cover.left, cover.right).max(axis=0))
        return Cover(cover.left * largest[:, None], cover.right)

    def _of(self, part: Part, G: Array, Gp: Array) -> Array:
        """Return the residuals of some units, or what these leave out."""
        return residual(self.asked.form, G, Gp) if part is Part.RESIDUAL else completion(self.asked.form, G, Gp)[1]

    def _sizes(self) -> tuple[Array, Array]:
        """Return the misfit of all units, shape (unit, frequency), and the largest residual, shape (frequency,)."""
        G, ratios, bound = self.base.frequency_response(self.freqs_hz), [], np.zeros(len(self.freqs_hz))
        for block in self.blocks():
            Gp = self.units[block].frequency_response(self.freqs_hz)
            E = residual(self.asked.form, G, Gp)
            ratios.append(misfit(self.asked.form, G, Gp, E))
            bound = np.maximum(bound, sigma_max(E).max(axis=0))
        return np.concatenate(ratios), bound


def _ratio(weight: Weight, E: Array, freqs_hz: Array) -> Array:
    """Return the ratios of residuals and a weight, shape (unit, frequency)."""
    used = weight.magnitudes(freqs_hz)
    return cover_ratio(E, used.left, used.right)


def _beyond(ratio: Array) -> Array:
    """Return the units with the largest ratio at some frequency, where that is above one."""
    return np.unique(ratio.argmax(axis=0)[ratio.max(axis=0) > 1])


def _lifted(weight: Weight, proof: _Proof) -> Weight:
    """Scale a weight to what was found of all units, where some are beyond it."""
    lift = max(proof.bound, proof.on_grid) * (1 + _MARGIN) if max(proof.bound, proof.on_grid) > 1 else 1.0
    margin = 1 - max(proof.bound, proof.on_grid) / lift
    return replace(weight.scaled(lift), cover_max=proof.on_grid / lift, method=proof.method, remaining_margin=margin)
