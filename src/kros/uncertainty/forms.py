r"""The six uncertainty forms of section II-A.4: residual from two plants, perturbed plant from a residual.

======================  =====================================  =========================  =============================
form                    perturbed plant                        residual                   exact when
======================  =====================================  =========================  =============================
additive                Gp = G + E                             Gp - G                     always
input_multiplicative    Gp = G (1 + E)                         G^+ (Gp - G)               range(Gp - G) in range(G)
output_multiplicative   Gp = (1 + E) G                         (Gp - G) G^+               rows(Gp - G) in rows(G)
inverse_additive        Gp = G (1 - E G)^-1                    Gp^+ (Gp - G) G^+          range(G) in range(Gp), rows
inverse_input_...       Gp = G (1 - E)^-1                      Gp^+ (Gp - G)              range(G) in range(Gp)
inverse_output_...      Gp = (1 - E)^-1 G                      (Gp - G) Gp^+              rows(G) in rows(Gp)
======================  =====================================  =========================  =============================

The inverse forms also need the inverted matrix to be regular. Elsewhere the residual is the least-squares fit, what it
does not rebuild is the misfit, and `completion` covers that by an additive remainder. `paper=True` gives the published
pipeline's variants of the multiplicative forms, `G^+ Gp - 1`, `Gp G^+ - 1`, `1 - Gp^+ G` and `1 - G Gp^+`: with more
outputs than inputs the output ones contain the identity on the complement of the range, whatever the plants.

Plants here are already in scaled coordinates. Nothing in this module chooses, fits or stores.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from enum import StrEnum
from typing import Any

import numpy as np

from ..core import EPS, ROUNDING, TINY, AnyArray, Array, ArrayLike, ConfigError, DataError, DimensionError, member
from ..core.frequency import nyquist_hz
from ..core.linalg import sigma_max
from .settings import SET


class Form(StrEnum):
    """Where the perturbation acts.

    Examples
    --------
    >>> from kros.uncertainty import Form
    >>> Form.ADDITIVE.inverse, Form("inverse_additive").inverse, len(Form)
    (False, True, 6)
    """

    ADDITIVE = "additive"
    INPUT_MULTIPLICATIVE = "input_multiplicative"
    OUTPUT_MULTIPLICATIVE = "output_multiplicative"
    INVERSE_ADDITIVE = "inverse_additive"
    INVERSE_INPUT_MULTIPLICATIVE = "inverse_input_multiplicative"
    INVERSE_OUTPUT_MULTIPLICATIVE = "inverse_output_multiplicative"

    @property
    def inverse(self) -> bool:
        """Whether the perturbation sees its own effect, so that the perturbed plant is rebuilt by an inverse."""
        return self.value.startswith("inverse")

    @property
    def at_input(self) -> bool:
        """Whether the perturbation acts on the plant's input, otherwise on its output."""
        return self in (Form.INPUT_MULTIPLICATIVE, Form.INVERSE_ADDITIVE, Form.INVERSE_INPUT_MULTIPLICATIVE)

    @property
    def sees_input(self) -> bool:
        """Whether the perturbation sees the plant's input, otherwise its output."""
        return self in (Form.ADDITIVE, Form.INPUT_MULTIPLICATIVE, Form.INVERSE_INPUT_MULTIPLICATIVE)

    def sizes(self, outputs: int, inputs: int) -> tuple[int, int]:
        """Return rows and columns of a residual between plants of a shape."""
        return inputs if self.at_input else outputs, inputs if self.sees_input else outputs


def evenly(count: int, most: int) -> AnyArray:
    """Return at most so many rows, spread evenly over all."""
    return np.unique(np.linspace(0, count - 1, most).round().astype(int))


def as_form(form: Form | str) -> Form:
    """Return the form of a name, or raise a `ConfigError`."""
    return member(Form, form, "Uncertainty form")


def residual(form: Form | str, nominal: ArrayLike, perturbed: ArrayLike, *, paper: bool = False) -> AnyArray:
    """Return the residual E between a nominal and perturbed plants.

    Parameters
    ----------
    form : Form or str
    nominal, perturbed : array_like, shape (..., p, m), complex
        Leading axes broadcast.
    paper : bool
        The published pipeline's variant of the multiplicative forms.

    Returns
    -------
    ndarray, shape (..., p', m')
        Outputs by inputs for the additive form, inputs by outputs for the inverse additive one; inputs by inputs on the
        input side, outputs by outputs on the output side.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.uncertainty import residual
    >>> residual("input_multiplicative", np.diag([1.0, 2.0]), np.diag([1.5, 2.0]))
    array([[0.5, 0. ],
           [0. , 0. ]])
    """
    form = as_form(form)
    G, Gp = np.asarray(nominal), np.asarray(perturbed)
    if G.ndim < 2 or Gp.ndim < 2 or G.shape[-2:] != Gp.shape[-2:]:
        problem = f"Residual: both plants need the shape (..., outputs, inputs), found {G.shape} and {Gp.shape}"
        raise DimensionError(f"{problem}; bring them to the same channels.")
    if not paper or form.at_input is not form.sees_input:
        return residual_of(form, G, Gp, np.linalg.pinv)
    inverse, other = (np.linalg.pinv(Gp), G) if form.inverse else (np.linalg.pinv(G), Gp)
    product = inverse @ other if form.at_input else other @ inverse
    one = np.eye(product.shape[-1])
    return one - product if form.inverse else product - one


def residual_of(form: Form, G: Any, Gp: Any, pinv: Callable[[Any], Any]) -> Any:
    """Return the residual of arrays, or of other plants with sums, products and a pseudo-inverse."""
    E, other = Gp - G, Gp if form.inverse else G
    E = pinv(other) @ E if form.at_input else E
    return E if form.sees_input else E @ pinv(G if form.at_input else other)


def rebuild(form: Form | str, nominal: ArrayLike, E: ArrayLike) -> AnyArray:
    """Return the perturbed plants, shape (..., p, m), that a nominal and residuals stand for.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.uncertainty import rebuild, residual
    >>> nominal, unit = np.array([[2.0]]), np.array([[2.5]])
    >>> E = residual("output_multiplicative", nominal, unit)
    >>> E.tolist(), rebuild("output_multiplicative", nominal, E).tolist()
    ([[0.25]], [[2.5]])
    """
    form, G, E = as_form(form), np.asarray(nominal), np.asarray(E)
    if not form.inverse:
        return G + change_of(form, G, E)
    loop = loop_of(form, G, E)
    one = np.eye(loop.shape[-1])
    regular = (np.linalg.cond(one - loop) < 1 / EPS)[..., None, None]
    inverse = np.where(regular, np.linalg.inv(np.where(regular, one - loop, one)), np.nan)
    return G @ inverse if form.at_input else inverse @ G


def change_of(form: Form, G: Any, E: Any) -> Any:
    """Return what a form without an inverse adds to the nominal plant."""
    seen = E if form.sees_input else E @ G
    return G @ seen if form.at_input else seen


def loop_of(form: Form, G: Any, E: Any) -> Any:
    """Return L of an inverse form, whose inverse is that of ``1 - L``."""
    return E if form.at_input is form.sees_input else E @ G


def misfit(form: Form | str, nominal: ArrayLike, responses: ArrayLike) -> AnyArray:
    """Return what the form cannot rebuild: `sigma_max(rebuilt Gp - Gp) / sigma_max(Gp)`.

    Parameters
    ----------
    form : Form or str
    nominal : array_like, shape (frequency, p, m), complex
    responses : array_like, shape (unit, frequency, p, m), complex

    Returns
    -------
    ndarray, shape (unit, frequency)
        NaN where the matrix that the form inverts has a condition number above 1e12; zero where the plant itself is
        zero.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.uncertainty import misfit
    >>> nominal = np.array([[[1.0], [0.0]]])  # frequency, two outputs, one input
    >>> misfit("input_multiplicative", nominal, np.array([[[[1.0], [0.1]]]])).round(3).tolist()
    [[0.1]]
    """
    _, rest, regular = completion(form, nominal, responses)
    error, size = sigma_max(rest), sigma_max(responses)
    ratio = np.divide(error, size, out=np.zeros_like(error), where=size > 0)
    return np.where(regular, ratio, np.nan)


def completion(form: Form | str, nominal: ArrayLike, responses: ArrayLike) -> tuple[AnyArray, AnyArray, AnyArray]:
    """Return residuals, zero where an inverse form is near singular, the remainder, and where it is not."""
    form, G, Gp = as_form(form), np.asarray(nominal), np.asarray(responses)
    E = residual(form, G, Gp)
    regular = np.ones(E.shape[:-2], bool)
    if form.inverse:
        loop = loop_of(form, G, E)
        regular = np.linalg.cond(np.eye(loop.shape[-1]) - loop) <= SET.condition
        E = np.where(regular[..., None, None], E, 0.0)
    return E, Gp - rebuild(form, G, E), regular


def check_responses(responses: Any, ids: Sequence[str] | None = None, freqs_hz: AnyArray | None = None) -> AnyArray:
    """Return responses (unit, frequency, p, m), or say which one is not like the first, or not finite."""
    arrays = [np.asarray(one) for one in responses]
    names = ids or [str(k) for k in range(len(arrays))]
    for name, one in zip(names, arrays, strict=False):
        if one.shape != arrays[0].shape:
            both = f"{name!r} has the shape {one.shape}, that of {names[0]!r} {arrays[0].shape}"
            raise DimensionError(f"Responses: that of {both}; bring all to the same frequencies and channels.")
    G = np.asarray(arrays)
    if G.ndim != 4 or 0 in G.shape or len(names) != len(G):
        problem = "needs axes (unit, frequency, output, input), none empty, and a name for each unit"
        raise DimensionError(f"Responses: {problem}; found shape {G.shape} and {len(names)} names.")
    if freqs_hz is not None and len(freqs_hz) != G.shape[1]:
        raise DimensionError(f"Responses: {G.shape[1]} frequencies need as many freqs_hz, found {len(freqs_hz)}.")
    finite = np.isfinite(G).all(axis=(2, 3))
    if not finite.all():
        unit, row = np.argwhere(~finite)[0]
        place = f"row {row}" if freqs_hz is None else f"{freqs_hz[row]:.6g} Hz"
        problem = f"that of unit {names[unit]!r} has NaN or infinity at {place}, {int((~finite).sum())} in all"
        raise DataError(f"Responses: {problem}; leave the unit out, or look at its model.")
    return G


def check_grid(freqs_hz: ArrayLike, sample_period_s: float | None) -> Array:
    """Return the frequencies as an array, or say why they are no grid; without a sampling period of continuous time."""
    freqs = np.atleast_1d(np.asarray(freqs_hz, dtype=float))
    top = np.inf if sample_period_s is None else nyquist_hz(sample_period_s)
    increasing = np.isfinite(freqs).all() and (np.diff(freqs, prepend=-TINY) > 0).all()
    if freqs.ndim != 1 or not freqs.size or not increasing or (sample_period_s is None and freqs[-1] == 0):
        problem = f"found shape {freqs.shape}, {freqs.ravel()[:5]} ..., {np.isnan(freqs).sum()} NaN"
        remedy = "sort them and drop doubles"
        raise ConfigError(
            f"Frequency grid: needs frequencies in Hz that increase from zero or above, {problem}; {remedy}."
        )
    if freqs[-1] > top * (1 + ROUNDING):
        limit = f"the Nyquist frequency {top} Hz of the sampling period {sample_period_s} s"
        raise ConfigError(f"Frequency grid: {freqs[-1]} Hz is above {limit}; end the grid there.")
    return freqs
