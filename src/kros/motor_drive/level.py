r"""The level of a load that is fixed to an angle, and drives at their current limit.

What is seen of a load lacks its level (`without_level`). A mass mounted off the axis takes ``tau = c_1 sin(theta) + c_2
cos(theta)`` plus what is fast. The same filter makes ``psi = H phi`` of ``phi = [sin(theta), cos(theta)]``, so that the
seen part gives c by least squares as soon as the machine turns,

.. math:: \hat c_k = \Bigl(\sum_j \psi_j \psi_j^T T + \epsilon I\Bigr)^{-1} \sum_j \psi_j \hat\tau_s(j) T, \qquad
          \hat\tau = \hat\tau_s + (\varphi - \psi)^T \hat c .

A controller at its limit holds its integrator back. Where the total current comes out beyond the limit, the excess is
taken off the load, and forgotten as slowly as levels are. If that would move the load by more than `trusted` from what
c says of the angle, it is no load: changes are counted again from there, and what excess remains is taken off what the
unloaded machine needs.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ..core import Array, ArrayLike, DimensionError


class LoadAndCurrent(NamedTuple):
    """Load and total current with their levels, both of one shape and in the current's unit."""

    load: Array
    current: Array


@dataclass(frozen=True)
class AngleLoad:
    """Fill in the level of loads that are fixed to an angle.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.motor_drive import AngleLoad
    >>> position = np.linspace(0.0, 3.0, 3000)[:, None]
    >>> seen = 0.2 * np.sin(position)  # sample, episode
    >>> AngleLoad(level_s=100.0, sample_period_s=0.001).run(seen, seen, position).load.shape
    (3000, 1)
    """

    level_s: float  # s; of the load observer (`LoadSettings`)
    sample_period_s: float
    settling_s: float = 0.1  # s; time at full swing (sin^2 of one half) after which half of c is used
    limit: float = np.inf  # of the current
    trusted: float = 0.5  # most that a load at the limit differs from what the angle says, as a share of the limit

    def run(self, seen: ArrayLike, current: ArrayLike, position: ArrayLike) -> LoadAndCurrent:
        """Return loads and currents with their levels, for signals of shape (n_samples, batch).

        `seen` and `current` are the observer's load and current in the current's unit, `position` is measured in rad;
        where it is NaN the last angle stands for it.
        """
        seen, current, position = (np.asarray(x, dtype=float) for x in (seen, current, position))
        if seen.ndim != 2 or not seen.shape == current.shape == position.shape:
            raise DimensionError(
                f"Level of a load: seen part {seen.shape}, current {current.shape} and position {position.shape} "
                f"should all be (n_samples, batch)."
            )
        rows = list(self._running(seen, current, position))
        return LoadAndCurrent(*(np.stack(column) for column in zip(*rows, strict=True)))

    def _running(self, seen: Array, current: Array, position: Array) -> Iterator[tuple[Array, Array]]:
        """Yield load and total current sample by sample, from the observer's and the measured angles in rad."""
        limit, pole = self.limit, self.pole
        directions = np.stack([np.sin(position), np.cos(position)], axis=-1)
        before = directions[0]
        psi, right = np.zeros_like(before), np.zeros_like(before)
        excess, need = np.zeros((2, len(before)))  # taken off the load, and off the unloaded current
        gram = np.tile(0.5 * self.settling_s * np.eye(2), (len(before), 1, 1))
        for tau, i, phi in zip(seen, current, directions, strict=True):
            phi = np.where(np.isnan(phi), before, phi)
            psi = pole * psi + np.nan_to_num(phi - before)
            before, excess, need = phi, pole * excess, pole * need
            coefficients = np.linalg.solve(gram, right[..., None])[..., 0]
            of_angle = np.sum(np.nan_to_num(phi) * coefficients, axis=1)  # zero where no angle has arrived yet
            load = tau - excess + of_angle - np.sum(psi * coefficients, axis=1)
            total = i - tau - need + load
            bounded = np.clip(total, -limit, limit)
            beyond = bounded != total
            if beyond.any():
                shifted = load - (total - bounded)
                trusted = beyond & (np.abs(shifted - of_angle) <= self.trusted * limit)
                anew = beyond & ~trusted
                excess[trusted] += (total - bounded)[trusted]
                load[trusted] = shifted[trusted]
                psi[anew], excess[anew], load[anew] = 0.0, tau[anew], of_angle[anew]
                total[anew] = (i - tau - need + load)[anew]
                bounded[anew] = np.clip(total[anew], -limit, limit)
                need[anew] += (total - bounded)[anew]
            learned = psi * np.where(beyond, 0.0, self.sample_period_s)[:, None]
            gram = gram + learned[..., None] * psi[:, None]
            right = right + learned * (tau - excess)[:, None]
            yield load, bounded

    @property
    def pole(self) -> float:
        """What of a level is left after a sample."""
        return float(np.exp(-self.sample_period_s / self.level_s))
