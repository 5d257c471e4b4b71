r"""Is the H-infinity constraint within reach of any controller? Asked before the search, because no search ends well when it is not.

    Parrott's theorem at all frequencies, signals that no controller influences  -->  proven bound of ||T22||, in hundredths of a second
    first samples of the impulse response of T22 for any stable Q                -->  feasible at gamma? if not: their least norm

The first is exact where K does not enter T22 and for regular channels, the second is for channels without penalty or noise of their own.
"""

from __future__ import annotations

from ...core.errors import SynthesisError
from ...core.norms import hinf_norm
from ..generalized_plant import GeneralizedPlant
from ..riccati.hinf_bound import proven_bound
from .lower_bounds import hinf_lower_bound, samples_infeasible

_TOLERANCE = 1e-4


def require_attainable(plant: GeneralizedPlant, gamma: float, attained: float, time_limit_s: float) -> None:
    """Raise a `SynthesisError` when a bound shows that no controller attains the level.

    Parameters
    ----------
    plant : GeneralizedPlant
        With its channel partition.
    gamma : float
    attained : float
        Norm of T22 of any closed loop, where the search for the bound begins.
    time_limit_s : float
        For the impulse responses; the bound by signals takes what it takes.
    """
    require_reachable(plant, gamma, attained)
    if plant.dt > 0 and samples_infeasible(plant, gamma, time_limit_s=time_limit_s):
        _refuse(hinf_lower_bound(plant, time_limit_s=time_limit_s), gamma)


def require_reachable(plant: GeneralizedPlant, gamma: float, attained: float | None = None) -> None:
    """Raise a `SynthesisError` when the bound by signals shows that no controller attains the level; for any plant, continuous too."""
    two = plant.channel(plant.rows(2), plant.columns(2))
    if 0 in (two.sizes[1], two.sizes[3]):
        return
    if attained is None:
        loop = two.open_loop()
        attained = hinf_norm(loop) if loop.is_stable() else 10 * gamma
    _refuse(proven_bound(two, max(attained, 2 * gamma), _TOLERANCE), gamma)


def _refuse(least: float, gamma: float) -> None:
    if least >= gamma:
        raise SynthesisError(
            f"Mixed synthesis: gamma = {gamma:g} is infeasible, no controller has ||T22|| below {least:.6g}; raise gamma, or make the weights of "
            "channel 2 smaller."
        )
