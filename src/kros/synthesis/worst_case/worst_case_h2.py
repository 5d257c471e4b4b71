r"""Worst-case H2 observers: filtering of a shaped disturbance, by one Riccati equation.

K is outside the loop of the uncertainty, so the worst case over the set is a disturbance spectrum, and the best K for a given spectrum is a
Kalman predictor (state injection) or an H2 controller (input injection). The game between K and the spectrum is solved by fictitious play:
start from the average spectrum of the set, find the spectrum that is worst for the resulting K, then for the next, and average these. Every
iterate is certified independently and the best is kept, no correction and filters of lower orders among them (`search`). The last averaged spectrum
gives the lower bound.

The filters themselves are in `shaped_filter`; that a lower bound holds, in `everywhere` and `riccati.filter_bound`.
"""

from __future__ import annotations

from ...core.errors import SynthesisError
from ...core.lti import StateSpace
from ...core.norms import h2_norm
from ..problem.observer_problem import ObserverProblem
from ..result import Status, Synthesis, enclosed
from .disturbance import Channels, Fit, Shaping, default_fit, design_grid, symmetric
from .search import Search
from .shaped_filter import design


def worst_case_h2(
    problem: ObserverProblem,
    *,
    order: int | None = None,
    max_order: int = 4,
    tolerance_db: float = 1.0,
    refinements: int = 1,
    rtol: float = 1e-5,
    fit: Fit | None = None,
    bounded: bool = True,
) -> Synthesis:
    """Return an observer filter with a certified H2 norm for every member of the uncertain set.

    Parameters
    ----------
    problem : ObserverProblem
    order : int, optional
        Order of each shaping filter; default the smallest within `tolerance_db`, up to `max_order`, and lower ones where those do better.
    max_order : int
    tolerance_db : float
        Accuracy of the shaping filters. It costs optimality, never validity: the certificate uses the set itself.
    refinements : int
        Rounds of fictitious play after the first design.
    rtol : float
        Accuracy of the certificate's quadrature.
    fit : callable, optional
        ``fit(freqs_hz, magnitude, dt, order=, max_order=, tolerance_db=)`` with a result whose ``.system`` is a filter; default
        `kros.uncertainty.fit_magnitude`.
    bounded : bool
        False: only the first design, neither certified nor bounded from below, for those who design many and compare them on recordings.

    Returns
    -------
    Synthesis
        ``worst_case_h2`` with ``quadrature_error`` included, ``lower_bound`` for all observers of either injection, and their gap; ``h2_norm``
        is the norm of the error under measurement and process noise alone (the nominal machine).

    Raises
    ------
    SynthesisError
        When the set is not well posed, the pair undetectable, a model unstable, or a design does not survive verification.

    Examples
    --------
    >>> from kros.core import StateSpace, gain
    >>> from kros.synthesis import ObserverProblem, worst_case_h2
    >>> lag = StateSpace([[0.5]], [[1.0]], [[1.0]], [[0.0]], 0.01)
    >>> problem = ObserverProblem(lag, [[1.0]], gain([[0.1]], 0.01), gain([[1.0]], 0.01), [1.0], [1.0], [0.1])
    >>> found = worst_case_h2(problem, max_order=1)
    >>> found.lower_bound <= found.worst_case_h2, found.gap_percent < 5
    (True, True)
    """
    problem.require_sound()
    fit = fit or default_fit()
    options = {"order": order, "max_order": max_order, "tolerance_db": tolerance_db}
    channels = Channels(problem, design_grid(problem))
    spectrum = channels.average()
    if not bounded:
        return _design_alone(problem, channels.shaping(spectrum, fit, "above", options))
    search = Search(channels, fit, options, rtol)
    search.first(spectrum)
    for round_ in range(1, refinements + 1):
        spectrum = spectrum.mixed_with(*channels.worst(search.best.controller), 1 / round_)
        search.again(spectrum)
    if not symmetric(problem):
        return _result(problem, search, search.bound(channels.below_average()))
    worst = channels.worst(search.best.controller)
    return _result(problem, search, search.bound(spectrum.mixed_with(*worst, 1 / (refinements + 1))))


def _design_alone(problem: ObserverProblem, shaping: Shaping) -> Synthesis:
    controller = design(problem, shaping)
    radius = float(problem.error_system(controller).spectral_radius())
    if radius >= 1:
        raise SynthesisError(
            f"Worst-case H2 synthesis: the loop has spectral radius {radius:.9g}; add noise, or lower the order of the weights."
        )
    notes = ("A design alone, without certificate.",)
    return Synthesis(
        "worst_case_h2",
        controller,
        Status.INACCURATE,
        problem.injection,
        spectral_radius=radius,
        solver="riccati",
        notes=notes,
    )


def _result(problem: ObserverProblem, search: Search, lower: float | None) -> Synthesis:
    best, loop = search.best, problem.error_system(search.best.controller)
    n_d = problem.nominal.n_inputs + problem.nominal.n_states
    lower, gap, notes = enclosed(best.value, lower)
    return Synthesis(
        method="worst_case_h2",
        controller=best.controller,
        status=Status.CERTIFIED,
        injection=problem.injection,
        h2_norm=h2_norm(StateSpace(loop.A, loop.B[:, n_d:], loop.C, loop.D[:, n_d:], loop.dt)),
        worst_case_h2=best.value,
        lower_bound=lower,
        gap_percent=gap,
        quadrature_error=best.error,
        spectral_radius=float(loop.spectral_radius()),
        solve_s=search.elapsed / search.designs,
        solver="riccati",
        notes=(
            "The spectral radius is that of the nominal loop; it says nothing about robustness. The certificate is worst_case_h2.",
            *notes,
        ),
    )
