"""Search for a proof: one Lyapunov matrix by a Riccati equation; a counterexample ends it."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import product

import numpy as np

from ...core.norms import hinf_norm
from .error import ErrorSystem
from .proof import Corners, margin, proven
from .riccati import Proposal, riccati_proposals
from .status import ReliftStatus

Proof = tuple[Proposal, float]  # with its margin
MOST_CORNERS = 64
_LONGEST = 3
_MANY_CORNERS = 4  # beyond which one larger matrix is decided sooner


def frozen_gain(system: ErrorSystem) -> float:
    """Return the largest gain that slopes frozen at a corner or in the middle attain."""
    width = system.L.shape[1]
    places = [
        np.zeros(width),
        *(product((-1.0, 1.0), repeat=width) if width > 0 and system.corner_count <= MOST_CORNERS else ()),
    ]
    return max(hinf_norm(system.frozen(place)) for place in places)


def prove(system: ErrorSystem) -> tuple[Proof | None, str, ReliftStatus]:
    """Return the first proof with its margin, or why there is none."""
    if system.corner_count > MOST_CORNERS:
        return _prove_by_multipliers(system)
    corners = system.corners()
    growing = growing_sequence(corners)
    if growing:
        return None, growing, ReliftStatus.UNSTABLE
    found = _first_proof(riccati_proposals(system), corners, system)
    if found is None:
        return None, "No Lyapunov function was found for all slopes in the box.", ReliftStatus.NOT_FOUND
    return found, "", ReliftStatus.CERTIFIED


def _first_proof(proposals: Iterable[Proposal], corners: Corners, system: ErrorSystem) -> Proof | None:
    """Return the first proposal that is proven, with its margin."""
    for proposal in proposals:
        if proven(proposal.root, corners, system.C, proposal.gain):
            return proposal, margin(proposal.root, corners, system.C, proposal.gain)
    return None


def _prove_by_multipliers(system: ErrorSystem) -> tuple[Proof | None, str, ReliftStatus]:
    """Prove a gain where there are too many corners to visit."""
    for proposal in riccati_proposals(system):
        assert proposal.multipliers is not None
        corner, C, D = system.multiplied(proposal.multipliers, proposal.gain)
        if proven(proposal.root, [corner], C, proposal.gain, D):
            return (proposal, margin(proposal.root, [corner], C, proposal.gain, D)), "", ReliftStatus.CERTIFIED
    reason = (
        f"{len(system.channels)} slopes move, too many to visit every corner of their box, and there are no multipliers that prove a gain; "
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


def mismatch_gain(system: ErrorSystem) -> float | None:
    """Return kappa."""
    if not system.L.shape[1]:
        return 0.0
    found, _, _ = prove(system.mismatch())
    return None if found is None else found[0].gain


def quick_gain(system: ErrorSystem) -> float:
    """Return a proven gain of one system by Riccati equations alone, infinite where they prove none."""
    found = _prove_by_multipliers(system)[0] if system.corner_count > _MANY_CORNERS else None
    if found is None and system.corner_count <= MOST_CORNERS:
        found = _first_proof(riccati_proposals(system), system.corners(), system)
    return np.inf if found is None else found[0].gain
