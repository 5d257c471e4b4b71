r"""The generalized plant of Figure 1, and its closure with a controller.

Interconnection of systems by named wires: every block once, so that no state is there twice.

Symbols
-------
x : state, (n,);  w : disturbances, (n_w,);  u : control, (n_u,);  z : performance, (n_z,);  y : measurements, (n_y,)
K : controller with matrices A^c, B^c, C^c, D^c
x, v, y : states, inputs and outputs of all blocks, stacked;  w, z : inputs and outputs of the whole
F, H, P, Q : ``v = F y + H w``,  ``z = P y + Q w``
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import product

import numpy as np

from ..core import SINGULAR, AnyArray, DimensionError, frozen
from ..core.lti import StateSpace, block_diagonal, real_array, sampling_period

_MATRICES = ("A", "B1", "B2", "C1", "D11", "D12", "C2", "D21", "D22")  # row by row


@frozen
class GeneralizedPlant:
    r"""Plant with weights, before the controller is connected.

    ::

                 +-------------------------+
        z <------| x+ = A x + B1 w  + B2 u |<------ w
                 | z  = C1 x + D11 w + D12 u|
            +----| y  = C2 x + D21 w + D22 u|<---+
          y |    +-------------------------+    | u
            |            +-----+                |
            +----------->|  K  |----------------+      u = + K y
                         +-----+

    Raises
    ------
    DimensionError
        When shapes do not fit together, or a partition is out of range.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.core import gain, h2_norm
    >>> from kros.synthesis import GeneralizedPlant
    >>> D11, D12, D21 = np.zeros((2, 2)), [[0.0], [1.0]], [[0.0, 1.0]]
    >>> B1, C1 = [[1.0, 0.0]], [[1.0], [0.0]]
    >>> plant = GeneralizedPlant([[0.9]], B1, [[1.0]], C1, [[1.0]], D11, D12, D21, [[0.0]], 1.0)
    >>> bool(h2_norm(plant.close(gain([[-0.5]], 1.0))) < h2_norm(plant.open_loop()))
    True
    """

    A: AnyArray  # (n, n)
    B1: AnyArray  # (n, n_w)
    B2: AnyArray  # (n, n_u)
    C1: AnyArray  # (n_z, n)
    C2: AnyArray  # (n_y, n)
    D11: AnyArray  # (n_z, n_w)
    D12: AnyArray  # (n_z, n_u)
    D21: AnyArray  # (n_y, n_w)
    D22: AnyArray  # (n_y, n_u)
    dt: float  # s; 0 means continuous time
    n_w1: int | None = None  # for `mixed`: so many disturbances are w1 (performance), the others w2; default all
    n_z1: int | None = None  # for `mixed`: so many outputs are z1, the others z2; default all

    def __post_init__(self) -> None:
        for name in _MATRICES:
            object.__setattr__(self, name, np.atleast_2d(real_array(f"Generalized plant: {name}", getattr(self, name))))
        object.__setattr__(self, "dt", sampling_period("Generalized plant", self.dt))
        n, (n_z, n_y) = self.A.shape[-1], (len(self.C1), len(self.C2))
        n_w, n_u = self.B1.shape[-1], self.B2.shape[-1]
        for name, shape in zip(_MATRICES, product((n, n_z, n_y), (n, n_w, n_u)), strict=True):
            if getattr(self, name).shape != shape:
                shapes = {key: getattr(self, key).shape for key in _MATRICES}
                raise DimensionError(f"Generalized plant: {name} should have shape {shape}, found {shapes}.")
        if not all(np.isfinite(getattr(self, name)).all() for name in _MATRICES):
            raise DimensionError("Generalized plant: a matrix contains NaN or infinity; check the weights.")
        for name, part, whole in (("n_w1", self.n_w1, n_w), ("n_z1", self.n_z1, n_z)):
            if part is not None and not 0 <= part <= whole:
                raise DimensionError(f"Generalized plant: {name} = {part} should lie between 0 and {whole}.")

    @property
    def sizes(self) -> tuple[int, int, int, int, int]:
        """Sizes of x, w, u, z, y."""
        return self.A.shape[0], self.B1.shape[1], self.B2.shape[1], self.C1.shape[0], self.C2.shape[0]

    def rows(self, channel: int) -> slice:
        """Rows of z that belong to channel 1 (performance) or 2 (uncertainty)."""
        split = self.sizes[3] if self.n_z1 is None else self.n_z1
        return slice(0, split) if channel == 1 else slice(split, None)

    def columns(self, channel: int) -> slice:
        """Columns of w that belong to channel 1 (performance) or 2 (uncertainty)."""
        split = self.sizes[1] if self.n_w1 is None else self.n_w1
        return slice(0, split) if channel == 1 else slice(split, None)

    def channel(self, rows: slice | AnyArray, columns: slice | AnyArray) -> GeneralizedPlant:
        """Return the plant restricted to some performance outputs and disturbances."""
        _, n_w, _, n_z, _ = self.sizes
        whole = replace(self, n_w1=None, n_z1=None)
        return whole.transformed(z=np.eye(n_z)[rows], w=np.eye(n_w)[:, columns])

    def transformed(
        self,
        *,
        x: tuple[AnyArray, AnyArray] | None = None,
        z: AnyArray | None = None,
        w: AnyArray | None = None,
        y: AnyArray | None = None,
        u: AnyArray | None = None,
    ) -> GeneralizedPlant:
        """Return the plant in the states ``T x`` for ``x = (T, T^-1)``, outputs multiplied by z, y, inputs by w, u."""
        n, n_w, n_u, n_z, n_y = self.sizes
        T, back = x or (np.eye(n), np.eye(n))
        w, u, z, y = (np.eye(size) if M is None else M for M, size in ((w, n_w), (u, n_u), (z, n_z), (y, n_y)))
        matrices = (
            row @ getattr(self, name) @ column
            for name, (row, column) in zip(_MATRICES, product((T, z, y), (back, w, u)), strict=True)
        )
        return replace(self, **dict(zip(_MATRICES, matrices, strict=True)))

    @property
    def performance(self) -> GeneralizedPlant:
        """The plant of channel 1 alone, from w1 to z1."""
        return self.channel(self.rows(1), self.columns(1))

    @property
    def uncertainty(self) -> GeneralizedPlant:
        """The plant of channel 2 alone, from w2 to z2."""
        return self.channel(self.rows(2), self.columns(2))

    @property
    def dual(self) -> GeneralizedPlant:
        """The transposed plant: z and w change places, and so do y and u."""
        p = self
        return GeneralizedPlant(p.A.T, p.C1.T, p.C2.T, p.B1.T, p.B2.T, p.D11.T, p.D21.T, p.D12.T, p.D22.T, p.dt)

    def open_loop(self) -> StateSpace:
        """Return the plant as one system from (w, u) to (z, y)."""
        D = np.block([[self.D11, self.D12], [self.D21, self.D22]])
        return StateSpace(self.A, np.hstack([self.B1, self.B2]), np.vstack([self.C1, self.C2]), D, self.dt)

    def close(self, controller: StateSpace) -> StateSpace:
        r"""Lower linear fractional transformation: the system from w to z with ``u = K y``.

        Parameters
        ----------
        controller : StateSpace
            Or any object with `A, B, C, D, dt`: ``n_u`` outputs, ``n_y`` inputs, the plant's sampling period.

        Raises
        ------
        DimensionError
            When sizes or sampling periods differ, or the loop is not well posed (``I - D22 D^c`` singular).
        """
        K = StateSpace.of(controller)
        n, _, n_u, _, n_y = self.sizes
        if (K.n_outputs, K.n_inputs) != (n_u, n_y) or K.dt != self.dt or K.batch_shape:
            size = f"{K.n_outputs} x {K.n_inputs} at {K.dt} s"
            raise DimensionError(
                f"Closing the loop: the controller should be {n_u} x {n_y} at {self.dt} s, found {size}."
            )
        loop = np.eye(n_y) - self.D22 @ K.D
        if n_y and np.linalg.cond(loop) > SINGULAR:
            raise DimensionError("Closing the loop: I - D22 D^c is singular; use a strictly proper controller.")
        # y = loop^-1 (C2 x + D21 w + D22 C^c x^c),  u = C^c x^c + D^c y; large gains stay out of what is inverted
        solved = np.linalg.solve(loop, np.hstack([self.C2, self.D22 @ K.C, self.D21]))
        y_x, y_w = np.split(solved, [n + K.n_states], axis=1)
        u_x, u_w = K.D @ y_x + np.hstack([np.zeros((n_u, n)), K.C]), K.D @ y_w
        more = (0, 0), (0, K.n_states)
        A = np.vstack([np.pad(self.A, more) + self.B2 @ u_x, K.B @ y_x])
        A[n:, n:] += K.A
        B, C = np.vstack([self.B1 + self.B2 @ u_w, K.B @ y_w]), np.pad(self.C1, more) + self.D12 @ u_x
        return StateSpace(A, B, C, self.D11 + self.D12 @ u_w, self.dt)


def split(system: StateSpace, n_w: int, n_z: int, **parts: int | None) -> GeneralizedPlant:
    """Cut a system from (w, u) to (z, y) into the nine matrices; `parts` are n_w1 and n_z1."""
    (B1, B2), (C1, C2) = np.split(system.B, [n_w], axis=1), np.split(system.C, [n_z])
    (D11, D12), (D21, D22) = (np.split(D, [n_w], axis=1) for D in np.split(system.D, [n_z]))
    return GeneralizedPlant(system.A, B1, B2, C1, C2, D11, D12, D21, D22, system.dt, **parts)


Sum = Mapping[str, AnyArray | float]  # of sources, each with a matrix, or a multiple of the identity


def interconnect(
    blocks: Mapping[str, StateSpace], wires: Mapping[str, Sum], inputs: Mapping[str, int], outputs: Mapping[str, Sum]
) -> StateSpace:
    """Return the system from `inputs` to `outputs`."""
    whole = block_diagonal(list(blocks.values()))
    sources = {name: block.n_outputs for name, block in blocks.items()}
    heights = {name: block.n_inputs for name, block in blocks.items()}
    F, H = _matrix(wires, heights, sources), _matrix(wires, heights, inputs)
    sums = ((name, *source) for name, row in outputs.items() for source in row.items())
    tall = {name: np.shape(value)[0] if np.ndim(value) else sources[source] for name, source, value in sums}
    P, Q = _matrix(outputs, tall, sources), _matrix(outputs, tall, inputs)
    loop = np.eye(len(F)) - F @ whole.D
    if len(F) and np.linalg.cond(loop) > SINGULAR:
        raise DimensionError("Interconnection: an algebraic loop has no solution; put a delay into it.")
    v = np.linalg.solve(loop, np.hstack([F @ whole.C, H]))
    v_x, v_w = v[:, : whole.n_states], v[:, whole.n_states :]
    return StateSpace(
        whole.A + whole.B @ v_x, whole.B @ v_w, P @ (whole.C + whole.D @ v_x), P @ whole.D @ v_w + Q, whole.dt
    )


def _matrix(rows: Mapping[str, Sum], heights: Mapping[str, int], widths: Mapping[str, int]) -> AnyArray:
    """Stack the matrices of all sums, zero where a sum does not name a source."""

    def part(name: str, source: str) -> AnyArray:
        value = rows.get(name, {}).get(source, 0.0)
        return np.asarray(value) if np.ndim(value) else value * np.eye(heights[name], widths[source])

    return np.block([[part(name, source) for source in widths] for name in heights])
