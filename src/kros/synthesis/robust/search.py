"""Designs and lower bounds of worst-case H2 synthesis: what was tried, the best certified filter, the best proven bound."""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.errors import SynthesisError
from ...core.lti import StateSpace, gain
from ..problem.observer_problem import ObserverProblem
from .certificate import certify
from .disturbance import Channels, Fit, Shaping, Spectrum
from .everywhere import Everywhere
from .shaped_filter import design, lower_bound

Array = npt.NDArray[Any]
Options = dict[str, Any]
log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Certified:
    """A filter in physical units, its certified worst-case H2 norm, and the quadrature error in it."""

    value: float
    error: float
    controller: StateSpace


@dataclass(eq=False)
class Search:
    """What was found so far.

    Parameters
    ----------
    channels : Channels
    fit : callable
    rtol : float
        Of the certificate's quadrature.
    """

    channels: Channels
    fit: Fit
    rtol: float
    best: Certified | None = None
    latest: StateSpace | None = None
    lower: float | None = None
    options: Options = field(default_factory=dict)
    tried: list[Options] = field(default_factory=list)
    designed: int = 0
    elapsed: float = 0.0
    reasons: list[str] = field(default_factory=list)

    @property
    def problem(self) -> ObserverProblem:
        """What the filters are for."""
        return self.channels.problem

    def first(self, spectrum: Spectrum, options: Options) -> None:
        """Design for the first spectrum: with filters as asked, of order one, and no correction at all; where the first is not the best, of every order.

        Filters of a high order may have peaks between the frequencies that they are fitted at, and a design for what is not there.
        """
        self._certify(gain(np.zeros((self.problem.correction_size, len(self.problem.C))), self.problem.nominal.dt))
        self.options = options
        as_asked = self.design(spectrum, options)
        if options["order"] is None:
            orders = [1] if options["max_order"] > 1 else []
            for order in orders:
                other = self.design(spectrum, {**options, "order": order})
            if orders and min(other, self.best_value) < as_asked:
                for order in range(2, options["max_order"]):
                    self.design(spectrum, {**options, "order": order})
        if not self.designed:
            raise SynthesisError(f"Worst-case H2 synthesis: no design survived verification ({'; '.join(dict.fromkeys(self.reasons))}).")

    @property
    def best_value(self) -> float:
        """Smallest certified norm."""
        return np.inf if self.best is None else self.best.value

    def design(self, spectrum: Spectrum, options: Options) -> float:
        """Design for a spectrum and certify; infinite where that fails."""
        self.tried += [options] if options not in self.tried else []
        start = time.perf_counter()
        try:
            controller = design(self.problem, self.channels.shaping(spectrum, self.fit, "above", options))
            value = self._certify(controller)
        except SynthesisError as error:
            log.info("Shaping filters %s: %s", options, error)
            self.reasons.append(str(error))
            return np.inf
        finally:
            self.elapsed += time.perf_counter() - start
        self.designed += 1
        if value <= self.best_value or self.latest is None:
            self.latest, self.options = controller, options
        return value

    def _certify(self, controller: StateSpace) -> float:
        value, error = certify(self.problem, controller, self.rtol)
        if value < self.best_value:
            self.best = Certified(value, error, controller)
        return value

    def bound(self, proofs: Everywhere, spectrum: Spectrum) -> None:
        """Raise the lower bound by filters below a spectrum, of every kind that was designed with."""
        for options in self.tried:
            shaping: Shaping = proofs.lowered(self.channels.shaping(spectrum, self.fit, "below", options), spectrum)
            found = lower_bound(self.problem, shaping)
            if found is not None:
                self.lower = max(found, self.lower or 0.0)
