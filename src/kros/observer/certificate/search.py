"""Search for a proof: from one Lyapunov matrix by a Riccati equation to several by a semidefinite program; a counterexample ends it."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import product

import numpy as np

from ...core.norms import hinf_norm
from .error import ErrorSystem
from .proof import Corners, margin, proven
from .riccati import Proposal, riccati_proposals
from .sdp import sdp_proposal
from .status import ReliftStatus

Proof = tuple[Proposal, float]  # with its margin
MOST_CORNERS = 64
_LONGEST = 3
_MANY_CORNERS = 4  # beyond which one larger matrix is decided sooner
_BIG_SDP = 48  # states, beyond which a semidefinite program takes minutes
_CLOSE = 1.1


def frozen_gain(system: ErrorSystem) -> float:
    """Return the largest gain that slopes frozen at a corner or in the middle attain."""
    width = system.L.shape[1]
    places = [np.zeros(width), *(product((-1.0, 1.0), repeat=width) if width > 0 and system.corner_count <= MOST_CORNERS else ())]
    return max(hinf_norm(system.frozen(place)) for place in places)


def prove(modes: list[ErrorSystem], lookahead: int, time_limit_s: float, *, tight: bool = False) -> tuple[Proof | None, str, ReliftStatus]:
    """Return the first proof with its margin (where `tight`, the best of all methods), or why there is none."""
    system = modes[0]
    if system.corner_count > MOST_CORNERS:
        return _prove_by_multipliers(modes)
    corners = [corner for mode in modes for corner in mode.corners()]
    growing = growing_sequence(corners)
    if growing:
        return None, growing, ReliftStatus.UNSTABLE
    best = _first_proof(riccati_proposals(system), corners, system)
    first_does = not tight and len(modes) == 1  # a proposal for one mode may hold for others by its slack alone
    if best is not None and (first_does or best[0].gain <= _CLOSE * frozen_gain(system)):
        return best, "", ReliftStatus.CERTIFIED
    said = f"the program would have {len(system.A)} states, more than {_BIG_SDP}; reduce the correction filter's order"
    # Against one slope the Riccati equation loses nothing: another program for one matrix would find the same gain.
    lowest = 1 if best is not None and len(corners) == 2 else 0
    for depth in range(lowest, lookahead + 1 if len(system.A) <= _BIG_SDP else 0):
        if len(corners) ** (depth + 1) > MOST_CORNERS:
            break
        proposal, said = sdp_proposal(system, corners, depth, time_limit_s)
        found = _first_proof([proposal] if proposal else [], corners, system)
        if found is not None and (best is None or found[0].gain < best[0].gain):
            best = found
        if best is not None and not tight:
            break
    if best is not None:
        return best, "", ReliftStatus.CERTIFIED
    return None, f"No Lyapunov function was found for all slopes in the box ({said}).", ReliftStatus.NOT_FOUND


def _first_proof(proposals: Iterable[Proposal], corners: Corners, system: ErrorSystem) -> Proof | None:
    """Return the first proposal that is proven, with its margin."""
    for proposal in proposals:
        if proven(proposal.roots, corners, system.C, proposal.gain):
            return proposal, margin(proposal.roots, corners, system.C, proposal.gain)
    return None


def _prove_by_multipliers(modes: list[ErrorSystem]) -> tuple[Proof | None, str, ReliftStatus]:
    """Prove a gain where there are too many corners to visit."""
    for proposal in riccati_proposals(modes[0]):
        assert proposal.multipliers is not None
        parts = [mode.multiplied(proposal.multipliers, proposal.gain) for mode in modes]
        corners, (_, C, D) = [part[0] for part in parts], parts[0]
        if proven(proposal.roots, corners, C, proposal.gain, D):
            return (proposal, margin(proposal.roots, corners, C, proposal.gain, D)), "", ReliftStatus.CERTIFIED
    reason = (
        f"{len(modes[0].channels)} slopes move, too many to visit every corner of their box, and there are no multipliers that prove a gain; "
        "take a smaller box, or fewer functions."
    )
    return None, reason, ReliftStatus.NOT_FOUND


def growing_sequence(corners: Corners) -> str:
    """Name a short sequence of corners whose product does not shrink; empty where there is none among the short ones."""
    for length in range(1, _LONGEST + 1):
        if len(corners) ** length > MOST_CORNERS**2:
            break
        for sequence in product(range(len(corners)), repeat=length):
            matrix = np.linalg.multi_dot([corners[c][0] for c in sequence]) if length > 1 else corners[sequence[0]][0]
            radius = float(np.abs(np.linalg.eigvals(matrix)).max(initial=0.0))
            if radius >= 1:
                return (
                    f"The error grows: a sequence that repeats {length} corner{'s' if length > 1 else ''} of what can happen multiplies it by "
                    f"{radius ** (1 / length):.6g} a step."
                )
    return ""


def mismatch_gain(modes: list[ErrorSystem], lookahead: int, time_limit_s: float) -> float | None:
    """Return kappa; with dropped samples the frozen response has no single meaning, and there is none."""
    if not modes[0].L.shape[1]:
        return 0.0
    if len(modes) > 1:
        return None
    found, _, _ = prove([modes[0].mismatch()], lookahead, time_limit_s)
    return None if found is None else found[0].gain


def quick_gain(system: ErrorSystem) -> float:
    """Return a proven gain of one system by Riccati equations alone, infinite where they prove none."""
    found = _prove_by_multipliers([system])[0] if system.corner_count > _MANY_CORNERS else None
    if found is None and system.corner_count <= MOST_CORNERS:
        found = _first_proof(riccati_proposals(system), system.corners(), system)
    return np.inf if found is None else found[0].gain
