"""Search for a proof: a Lyapunov matrix by a Riccati equation, decided exactly."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np

from ...core.norms import hinf_norm
from .error import ErrorSystem
from .proof import proven
from .riccati import Proposal, riccati_proposals

MOST_CORNERS = 64  # that are visited
_LONGEST = 3
_FEW_CORNERS = 4  # that are decided one by one; for more, one larger matrix is decided sooner


def frozen_gain(system: ErrorSystem) -> float:
    """Return the largest gain that slopes frozen at a corner or in the middle attain."""
    width = system.L.shape[1]
    visited = width > 0 and system.corner_count <= MOST_CORNERS
    places = [np.zeros(width), *(product((-1.0, 1.0), repeat=width) if visited else ())]
    return max(hinf_norm(system.frozen(place)) for place in places)


def first_proof(system: ErrorSystem) -> Proposal | None:
    """Return the first proposal that is proven, for all corners of a small box, with multipliers for others."""
    few = system.corner_count <= _FEW_CORNERS
    for proposal in riccati_proposals(system):
        corners, C, D = system.corners() if few else [], system.C, None
        if not few:
            corner, C, D = system.multiplied(proposal.multipliers, proposal.gain)
            corners = [corner]
        if proven(proposal.root, corners, C, proposal.gain, D):
            return replace(proposal, multipliers=np.zeros(0)) if few else proposal
    return None


def growing_sequence(system: ErrorSystem) -> str:
    """Name a short sequence of corners whose product does not shrink, if there is one."""
    corners = system.corners() if system.corner_count <= MOST_CORNERS else []
    for length in range(1, _LONGEST + 1):
        if len(corners) ** length > MOST_CORNERS**2:
            break
        for sequence in product(range(len(corners)), repeat=length):
            matrix = np.linalg.multi_dot([corners[c][0] for c in sequence]) if length > 1 else corners[sequence[0]][0]
            radius = float(np.abs(np.linalg.eigvals(matrix)).max(initial=0.0))
            if radius >= 1:
                plural = "s" if length > 1 else ""
                return (
                    f"The error grows: a sequence that repeats {length} corner{plural} of what can happen multiplies "
                    f"it by {radius ** (1 / length):.6g} a step."
                )
    return ""


def proven_gain(system: ErrorSystem) -> float:
    """Return a proven gain of a system, infinite where there is none."""
    proof = first_proof(system)
    return np.inf if proof is None else proof.gain
