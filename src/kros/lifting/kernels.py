"""Radial basis functions and random Fourier features, as formulas.

With the scaled distance ``s**2 = sum_i ((q_i - c_i)/length_i)**2`` from a centre c:

    gaussian               exp(-s**2/2)
    multiquadric           sqrt(1 + s**2)
    inverse_multiquadric   1/sqrt(1 + s**2)
    thin_plate             s**2 log(s)
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum

import numpy as np
import numpy.typing as npt

from ..core.errors import ConfigError
from .families import Formulas, is_whole, number, require_count, require_names, wrapped

Array = npt.NDArray[np.float64]
_GUARD = 1e-30  # keeps the logarithm of the thin plate finite at the centre; changes no value by more than 1e-30


class Radial(str, Enum):
    """Kinds of radial basis functions."""

    GAUSSIAN = "gaussian"
    MULTIQUADRIC = "multiquadric"
    INVERSE_MULTIQUADRIC = "inverse_multiquadric"
    THIN_PLATE = "thin_plate"


class Kernel(str, Enum):
    """Kernels that random Fourier features approximate.

    Examples
    --------
    >>> from kros.lifting import Kernel
    >>> [kernel.value for kernel in Kernel]
    ['gaussian', 'laplacian']
    """

    GAUSSIAN = "gaussian"
    LAPLACIAN = "laplacian"


_TEXTS = {
    Radial.GAUSSIAN: "exp(-({s2})/2)",
    Radial.MULTIQUADRIC: "sqrt(1 + {s2})",
    Radial.INVERSE_MULTIQUADRIC: "1/sqrt(1 + {s2})",
    Radial.THIN_PLATE: "({s2})*log({s2} + " + repr(_GUARD) + ")/2",
}


def radial(
    names: Sequence[str], centres: npt.ArrayLike, length: float | Sequence[float], function: Radial | str = Radial.GAUSSIAN
) -> Formulas:
    """Return one radial basis function for every centre.

    Parameters
    ----------
    names : sequence of str
        Quantities, or formulas, that span the space; d of them.
    centres : array_like, shape (n_centres, d)
        In the units of the quantities; see `grid_centres`, `latin_hypercube_centres`, `random_centres`, `kmeans_centres`.
    length : float or sequence of float, shape (d,)
        Length scale of every quantity, in its unit.
    function : Radial or str

    Returns
    -------
    tuple of str

    Examples
    --------
    >>> radial(["position", "velocity"], [[0.5, 0]], [0.1, 2])
    ('exp(-(((position - 0.5)/0.1)**2 + (velocity/2)**2)/2)',)
    """
    names = require_names("radial", names)
    try:
        text = _TEXTS[Radial(function)]
    except ValueError as error:
        raise ConfigError(f"radial: function = {function!r} is unknown; known are {', '.join(r.value for r in Radial)}.") from error
    lengths = length_scales("radial", length, len(names))
    centres = np.asarray(centres, dtype=float)
    if centres.ndim != 2 or centres.shape[1] != len(names) or not len(centres) or not np.isfinite(centres).all():
        raise ConfigError(
            f"radial: centres for {list(names)} should be finite and have the shape (n, {len(names)}), found shape {centres.shape}."
        )
    return tuple(text.format(s2=_squared_distance(names, centre, lengths)) for centre in centres)


def fourier_features(
    names: Sequence[str], n: int, length: float | Sequence[float], seed: int, kernel: Kernel | str = Kernel.GAUSSIAN
) -> Formulas:
    """Return random Fourier features ``sqrt(2/n)*cos(w*q + b)``, whose inner product tends to a kernel as n grows.

    The Gaussian kernel is ``exp(-s**2/2)`` with the scaled distance s, the Laplacian kernel ``exp(-sum_i |q_i - p_i|/length_i)``.

    Parameters
    ----------
    names : sequence of str
        Quantities, or formulas; d of them.
    n : int
    length : float or sequence of float, shape (d,)
    seed : int
    kernel : Kernel or str

    References
    ----------
    A. Rahimi and B. Recht, "Random features for large-scale kernel machines", Advances in Neural Information Processing Systems 20, 2007.

    Examples
    --------
    >>> from kros.lifting import fourier_features
    >>> len(fourier_features(["angle", "rate"], n=20, length=[0.5, 2.0], seed=0))
    20
    """
    names = require_names("fourier", names)
    lengths = length_scales("fourier", length, len(names))
    if not is_whole(n, 1):
        raise ConfigError(f"fourier: n = {n!r} should be a whole number of at least 1.")
    require_count("fourier", n)
    rng = np.random.default_rng(seed)
    try:
        draw = {Kernel.GAUSSIAN: rng.standard_normal, Kernel.LAPLACIAN: rng.standard_cauchy}[Kernel(kernel)]
    except ValueError as error:
        raise ConfigError(f"fourier: kernel = {kernel!r} is unknown; known are {', '.join(k.value for k in Kernel)}.") from error
    frequencies = draw(size=(int(n), len(names))) / lengths
    shifts = rng.uniform(0, 2 * np.pi, size=int(n))
    size = number(np.sqrt(2 / n))
    return tuple(
        f"{size}*cos({' + '.join(f'({number(w)})*{wrapped(name)}' for w, name in zip(row, names, strict=True))} + {number(b)})"
        for row, b in zip(frequencies, shifts, strict=True)
    )


def length_scales(family: str, length: float | Sequence[float], n: int) -> Array:
    """Return n length scales from one or n, refusing what is not positive."""
    lengths = np.asarray(length, dtype=float)
    if lengths.shape not in ((), (n,)) or not np.isfinite(lengths).all() or np.any(lengths <= 0):
        raise ConfigError(f"{family}: length = {length} should be a positive number, or {n} of them, one for each quantity.")
    return np.broadcast_to(lengths, (n,))


def _squared_distance(names: Sequence[str], centre: Array, lengths: Array) -> str:
    terms = []
    for name, c, scale in zip(names, centre, lengths, strict=True):
        offset = wrapped(name) if c == 0 else f"({wrapped(name)} {'-' if c > 0 else '+'} {number(abs(c))})"
        terms.append(f"({offset}/{number(scale)})**2" if scale != 1 else f"{offset}**2")
    return " + ".join(terms)
