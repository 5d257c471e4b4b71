r"""Structured perturbations: a block diagonal Delta of full complex blocks and repeated complex scalars.

Symbols
-------
M : (z, w), seen by ``w = Delta z``;  X_L, X_R : positive definite, commute with the structure: ``X_R Delta = Delta X_L``
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.errors import DimensionError

Array = npt.NDArray[Any]


@dataclass(frozen=True)
class Block:
    """One block of a perturbation ``w = Delta z``.

    Parameters
    ----------
    rows : int
        Signals of w that it drives.
    columns : int
        Signals of z that it sees.
    repeated : bool
        ``delta I`` with one complex scalar delta, in place of a full complex matrix; then ``rows = columns``.

    Raises
    ------
    DimensionError
        When a size is not positive, or a repeated scalar is not square.

    Examples
    --------
    >>> from kros.synthesis import Block
    >>> Block.full(2, 3), Block(2, 2, repeated=True).columns
    (Block(rows=2, columns=3, repeated=False), 2)
    """

    rows: int
    columns: int
    repeated: bool = False

    def __post_init__(self) -> None:
        if self.rows < 1 or self.columns < 1 or (self.repeated and self.rows != self.columns):
            raise DimensionError(
                f"Perturbation block of {self.rows} x {self.columns}, repeated = {self.repeated}: sizes should be positive, "
                "and those of a repeated scalar equal."
            )

    @classmethod
    def full(cls, rows: int, columns: int | None = None) -> Block:
        """Full complex block; square unless `columns` is given."""
        return cls(rows, rows if columns is None else columns)

    @classmethod
    def scalar(cls, times: int = 1) -> Block:
        """One complex scalar, repeated `times` times."""
        return cls(times, times, times > 1)


@dataclass(frozen=True, eq=False)
class Structure:
    """All blocks of a perturbation, in order.

    Raises
    ------
    DimensionError
        When there is no block.
    """

    blocks: tuple[Block, ...]

    def __post_init__(self) -> None:
        if not self.blocks:
            raise DimensionError("Structured perturbation: needs at least one block, found none; use Block.full(rows, columns).")

    @classmethod
    def of(cls, blocks: Sequence[Block] | Structure, shape: tuple[int, ...] | None = None) -> Structure:
        """Return the structure of some blocks, and check that it fits a matrix M of a shape (..., z, w)."""
        structure = blocks if isinstance(blocks, Structure) else cls(tuple(blocks))
        if shape is not None and tuple(shape[-2:]) != structure.shape:
            raise DimensionError(
                f"Structured perturbation: blocks with {structure.shape[0]} inputs and {structure.shape[1]} outputs together need a matrix of "
                f"that shape, found {tuple(shape[-2:])}; w = Delta z, so rows of M are columns of Delta."
            )
        return structure

    @property
    def shape(self) -> tuple[int, int]:
        """Shape (z, w) of the matrix that the perturbation closes."""
        return sum(b.columns for b in self.blocks), sum(b.rows for b in self.blocks)

    def seen(self) -> list[slice]:
        """Rows of M of every block."""
        return _slices([b.columns for b in self.blocks])

    def driven(self) -> list[slice]:
        """Columns of M of every block."""
        return _slices([b.rows for b in self.blocks])

    def basis(self, diagonal: bool = False) -> tuple[Array, Array]:
        """Hermitian basis of the scalings: E_L (k, z, z) and E_R (k, w, w); the first elements sum to the identity.

        Parameters
        ----------
        diagonal : bool
            Leave out the off-diagonal elements of repeated scalars: fewer scalings, all of them rational without phase.
        """
        z, w = self.shape
        left, right = [], []
        for block, rows, columns in zip(self.blocks, self.seen(), self.driven(), strict=True):
            size = block.rows if block.repeated else 1
            for i in range(size):
                e_L, e_R = np.zeros((z, z), complex), np.zeros((w, w), complex)
                if block.repeated:
                    e_L[rows.start + i, rows.start + i] = e_R[columns.start + i, columns.start + i] = 1
                else:
                    e_L[rows, rows], e_R[columns, columns] = np.eye(block.columns), np.eye(block.rows)
                left.append(e_L)
                right.append(e_R)
        for block, rows, columns in zip(self.blocks, self.seen(), self.driven(), strict=True):
            if not block.repeated or diagonal:
                continue
            for i in range(block.rows):
                for j in range(i):
                    for unit in (1.0, 1j):
                        for part, start in ((left, rows.start), (right, columns.start)):
                            e = np.zeros((z, z) if part is left else (w, w), complex)
                            e[start + i, start + j], e[start + j, start + i] = unit, np.conj(unit)
                            part.append(e)
        return np.array(left), np.array(right)


def _slices(sizes: Sequence[int]) -> list[slice]:
    ends = np.cumsum([0, *sizes])
    return [slice(int(a), int(b)) for a, b in pairwise(ends)]
