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
        Neither a proof nor a counterexample was found. Allow a longer lookahead or more time, or take a smaller box.
    NOT_COVERED
        The observer runs in a way that the equations of the error do not know. No observer of this version does; it is kept for the reading of
        earlier certificates.

    Examples
    --------
    >>> from kros.observer import ReliftStatus
    >>> [status.value for status in ReliftStatus]
    ['certified', 'unstable', 'unbounded', 'not_found', 'not_covered']
    """

    CERTIFIED = "certified"
    UNSTABLE = "unstable"
    UNBOUNDED = "unbounded"
    NOT_FOUND = "not_found"
    NOT_COVERED = "not_covered"


class Dropped(str, Enum):
    """What the observer does at a step without a measurement; any pattern of such steps is covered.

    NEVER
        Every measurement arrives.
    INNOVATION
        The innovation is zero; the filter's own correction is applied.
    CORRECTION
        The innovation is zero and nothing is applied; the filter runs on.
    EITHER
        One or the other, from step to step.

    Examples
    --------
    >>> from kros.observer import Dropped
    >>> [dropped.value for dropped in Dropped]
    ['never', 'innovation', 'correction', 'either']
    """

    NEVER = "never"
    INNOVATION = "innovation"
    CORRECTION = "correction"
    EITHER = "either"
