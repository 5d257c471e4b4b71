"""What can come out of an attempt to certify an observer as it runs."""

from __future__ import annotations

from enum import Enum


class ReliftStatus(str, Enum):
    """What happened, and what to change.

    CERTIFIED
        The gain is proven.
    UNSTABLE
        A sequence of slopes inside the box makes the error grow without bound in the model: there is no certificate for this observer over this box.
        Take a smaller box, weaken the correction, or use another model.
    UNBOUNDED
        A lifted function may be arbitrarily steep. Name a box of states (and inputs) in which the observer works.
    NOT_FOUND
        Neither a proof nor a counterexample was found. Take a smaller box.

    Examples
    --------
    >>> from kros.observer import ReliftStatus
    >>> [status.value for status in ReliftStatus]
    ['certified', 'unstable', 'unbounded', 'not_found']
    """

    CERTIFIED = "certified"
    UNSTABLE = "unstable"
    UNBOUNDED = "unbounded"
    NOT_FOUND = "not_found"
