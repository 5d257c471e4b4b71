"""Designs and lower bounds of worst-case H2 synthesis: what was tried, the best certified filter, the best proven bound."""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...core.errors import SynthesisError
from ...core.lti import StateSpace, gain
from ..problem.observer_problem import ObserverProblem
from .certificate import certify
from .disturbance import Channels, Fit, Shaping, Spectrum
from .everywhere import Everywhere
from .shaped_filter import design, lower_bound

Options = dict[str, Any]
log = logging.getLogger(__name__)

_BOUND_ORDERS = (1, 2)  # of filters in lower bounds: W_L is behind them as it is, and what is left is smooth
_CLOSE = 0.9  # share of the certified value from which a lower bound is good enough


@dataclass(frozen=True, eq=False)
class Certified:
    """A filter in physical units, its certified worst-case H2 norm, and the quadrature error in it."""

    value: float
    error: float
    controller: StateSpace


class Search:
    """The best certified filter so far; it starts from no correction at all."""

    def __init__(self, channels: Channels, fit: Fit, options: Options, rtol: float) -> None:
        self.channels, self.fit, self.asked, self.rtol = channels, fit, options, rtol
        self.options = options  # of the kind that did best
        self.best = self._certified(self._nothing())
        self.designs, self.elapsed = 0, 0.0
        self.reasons: list[str] = []

    @property
    def problem(self) -> ObserverProblem:
        """What the filters are for."""
        return self.channels.problem

    def _nothing(self) -> StateSpace:
        return gain(np.zeros((self.problem.correction_size, len(self.problem.C))), self.problem.nominal.dt)

    def _certified(self, controller: StateSpace) -> Certified:
        return Certified(*certify(self.problem, controller, self.rtol), controller)

    def first(self, spectrum: Spectrum) -> None:
        """Design with shaping filters as asked and of order one; where the former are not the best, with those of every order."""
        as_asked = self.design(self._shaping(spectrum, self.asked), self.asked)
        highest = self.asked["max_order"]
        if self.asked["order"] is None and highest > 1:
            simple = self._shaping(spectrum, {**self.asked, "max_order": 1})
            self.design(simple, {**self.asked, "max_order": 1})
            if self.best.value < as_asked:
                for order in range(2, highest):
                    options = {**self.asked, "max_order": order}
                    self.design(self._shaping(spectrum, options, simple.remainder), options)
        if not self.designs:
            raise SynthesisError(
                f"Worst-case H2 synthesis: no design survived verification ({'; '.join(dict.fromkeys(self.reasons))})."
            )

    def again(self, spectrum: Spectrum) -> None:
        """Design for another spectrum with filters of the kind that did best."""
        self.design(self._shaping(spectrum, self.options), self.options)

    def _shaping(self, spectrum: Spectrum, options: Options, remainder: StateSpace | None = None) -> Shaping:
        return self.channels.shaping(spectrum, self.fit, "above", options, remainder)

    def design(self, shaping: Shaping, options: Options) -> float:
        """Design for shaped disturbances and certify; infinite where that fails."""
        start = time.perf_counter()
        try:
            controller = design(self.problem, shaping)
            self.elapsed += time.perf_counter() - start
            found = self._certified(controller)
        except SynthesisError as error:
            log.info("Shaping filters %s: %s", options, error)
            self.reasons.append(str(error))
            return float("inf")
        self.designs += 1
        if found.value < self.best.value:
            self.best, self.options = found, options
        return found.value

    def bound(self, spectrum: Spectrum) -> float | None:
        """Return the best lower bound of filters below a spectrum; None where none could be proven."""
        channels = Channels(self.problem, self.channels.freqs_hz, apart=True)
        proofs = Everywhere(channels)
        found = self._bound(proofs, channels.mixture(spectrum))
        if spectrum.thetas and (found or 0.0) < _CLOSE * self.best.value:
            calm = self._bound(proofs, channels.mixture(spectrum.calmed()))
            found = max((bound for bound in (found, calm) if bound is not None), default=None)
        return found

    def _bound(self, proofs: Everywhere, spectrum: Spectrum) -> float | None:
        highest = self.asked["max_order"] if self.asked["order"] is None else self.asked["order"]
        found, remainder = [], None
        for order in sorted({min(order, highest) for order in _BOUND_ORDERS}):
            shaping = proofs.channels.shaping(spectrum, self.fit, "below", {**self.asked, "order": order}, remainder)
            remainder = shaping.remainder
            found.append(lower_bound(self.problem, proofs.lowered(shaping, spectrum)))
        return max((bound for bound in found if bound is not None), default=None)
