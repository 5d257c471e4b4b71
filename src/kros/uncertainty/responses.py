"""Uncertainty from frequency responses alone: no state space is needed, and nothing is claimed between or beyond the frequencies given."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.errors import ConfigError, DataError, DimensionError
from ..core.frequency import check_grid
from .bilinear import BilinearAxis, check_continuous_grid
from .forms import Form, as_form
from .nominal.choice import Criterion, as_criterion
from .quantified import Quantified, findings
from .residuals import check_responses
from .systems import bound_continuous, choose_by
from .validation import check_fit, check_scale
from .weights.bounded import bound_residuals
from .weights.check import nearest
from .weights.cover import Structure, as_structure

Array = npt.NDArray[Any]

_LOG = logging.getLogger(__name__)
_RESOLVED, _ROUNDING = 10 ** (3 / 20), 1e-8


@dataclass(frozen=True, eq=False, kw_only=True)
class ResponseUncertainty(Quantified):
    """Weights that bound how measured frequency responses differ from a nominal one, at the frequencies given and nowhere else.

    Parameters
    ----------
    nominal_response : ndarray, shape (frequency, p, m), complex
        In physical units.
    sample_period_s : float, s
        Zero for continuous time.
    certificate : str
        Where the bound holds.
    unresolved_hz : ndarray, shape (n,), Hz
        Frequencies of local maxima of the bound that fall by more than 3 dB to a neighbouring frequency: peaks that the grid does not resolve, and
        that may be higher beside it. All other fields are those of `Quantified`.
    """

    nominal_response: Array
    sample_period_s: float
    certificate: str
    unresolved_hz: Array


def quantify_responses(
    responses: npt.ArrayLike,
    freqs_hz: npt.ArrayLike,
    form: Form | str = Form.INVERSE_INPUT_MULTIPLICATIVE,
    *,
    sample_period_s: float = 0.0,
    unit_ids: Sequence[str] | None = None,
    output_scale: npt.ArrayLike | None = None,
    input_scale: npt.ArrayLike | None = None,
    nominal: int | str | npt.ArrayLike | None = None,
    criterion: Criterion | str = Criterion.PEAK,
    extra: Mapping[str, npt.ArrayLike] | None = None,
    candidates: npt.ArrayLike | None = None,
    structure: Structure | str = Structure.DIAGONAL,
    max_order: int = 4,
    tolerance_db: float = 1.0,
) -> ResponseUncertainty:
    """Quantify how frequency responses of units differ from a nominal one.

    The weights are stable systems and bound the residuals at every frequency given, which is checked for the weights as returned; so is what they say
    about the tolerance. Between and beyond these frequencies the responses are not known, and nothing is claimed: take a grid that resolves every
    resonance. Peaks that it does not resolve are named, with a warning.

    Parameters
    ----------
    responses : array_like, shape (unit, frequency, p, m), complex
    freqs_hz : array_like, shape (frequency,), Hz
    form : Form or str
    sample_period_s : float, s
        Of the systems behind the responses, and of the weights; zero for continuous time, in which weights are fitted through the bilinear map of the axis.
    unit_ids : sequence of str, optional
    output_scale, input_scale : array_like, shape (p,) and (m,), optional
        Ranges; residuals and weights are in these units.
    nominal : int, str or array_like of shape (frequency, p, m), optional
        A unit, the name of a candidate, or a response of its own; by default the best by `criterion`.
    criterion : {"peak", "area", "cost"}
        See `choose_nominal`.
    extra : mapping of str to array_like, shape (frequency, p, m), optional
        Further candidates for the nominal by name.
    candidates : array_like of bool, shape (unit,), optional
        Units that may be nominal.
    structure : {"diagonal", "scalar", "full", "entrywise"}
        Of the weights; entrywise ones bound the entries and are sound for a diagonal perturbation only.
    max_order : int
    tolerance_db : float, dB

    Returns
    -------
    ResponseUncertainty

    Raises
    ------
    DimensionError
        Shapes that do not fit together.
    DataError
        Fewer than two units, NaN.
    ConfigError
        Frequencies that do not increase or are above Nyquist; unknown form, criterion or nominal.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.uncertainty import quantify_responses
    >>> freqs = np.geomspace(0.01, 100.0, 50)
    >>> gains = np.array([0.9, 1.0, 1.2])
    >>> lags = gains[:, None] / (1 + 2j * np.pi * freqs)
    >>> found = quantify_responses(lags[:, :, None, None], freqs, "output_multiplicative")
    >>> found.nominal, found.weight.cover_max <= 1
    (1, True)
    >>> round(float(abs(found.weight.left.frequency_response([1.0])[0, 0, 0])), 6)
    0.2
    """
    form, criterion, structure = as_form(form), as_criterion(criterion), as_structure(structure)
    check_fit(max_order, tolerance_db)
    G = check_responses(responses)
    freqs = check_grid(freqs_hz, sample_period_s) if sample_period_s > 0 else check_continuous_grid(freqs_hz)
    ids = tuple(str(k) for k in range(len(G))) if unit_ids is None else tuple(unit_ids)
    others = {name: np.asarray(value) for name, value in (extra or {}).items()}
    _check(G, freqs, ids, others)
    scales = check_scale("output", output_scale, G.shape[2]), check_scale("input", input_scale, G.shape[3])
    scaled = G / scales[0][:, None] * scales[1]
    extras = np.array([value / scales[0][:, None] * scales[1] for value in others.values()]).reshape(-1, *G.shape[1:])
    choices = choose_by(scaled, form, criterion, extras, candidates, freqs, structure)
    names = (*ids, *others)
    index, chosen = _nominal(nominal, G, others, names, choices[form].index)
    base = chosen / scales[0][:, None] * scales[1]
    options: dict[str, Any] = {"structure": structure, "max_order": max_order, "tolerance_db": tolerance_db, "sampled": True}

    def of_nominal(at_hz: Array) -> Array:
        return base[nearest(freqs, at_hz)]

    def of_units(at_hz: Array) -> Array:
        return scaled[:, nearest(freqs, at_hz)]

    if sample_period_s > 0:
        found = bound_residuals(form, of_nominal, of_units, freqs, sample_period_s, **options)
    else:
        found = bound_continuous(form, of_nominal, of_units, freqs, BilinearAxis.over(freqs), **options)
    unresolved = freqs[unresolved_peaks(found.bound)]
    certificate = f"at the {len(freqs)} frequencies given, {freqs[0]:.6g} to {freqs[-1]:.6g} Hz; not between or beyond them"
    if unresolved.size:
        some = ", ".join(f"{f:.4g}" for f in unresolved[:5]) + (" ..." if unresolved.size > 5 else "")
        certificate += f"; they do not resolve {unresolved.size} peak{'s' * (unresolved.size > 1)} of the residuals, at {some} Hz"
        _LOG.warning(
            "Weights of responses: the residuals peak within less than a step of the frequencies given, at %s Hz, and may be larger beside them; "
            "measure more densely there.",
            some,
        )
    return ResponseUncertainty(
        nominal_response=chosen,
        sample_period_s=float(sample_period_s),
        certificate=certificate,
        unresolved_hz=unresolved,
        **findings(form, ids, tuple(others), index, freqs, scales, choices, found),
    )


def unresolved_peaks(bound: Array) -> npt.NDArray[np.intp]:
    """Return the indices of inner local maxima from which a bound, shape (frequency,), falls by more than 3 dB to a neighbour.

    A resonance falls by 3 dB within its half-width: three points within its width show one that falls less.
    """
    middle, before, after = bound[1:-1], bound[:-2], bound[2:]
    peaks = (middle >= before) & (middle >= after) & (middle > np.maximum(_RESOLVED * np.minimum(before, after), _ROUNDING * bound.max()))
    return np.flatnonzero(peaks) + 1


def _check(G: Array, freqs: Array, ids: tuple[str, ...], others: Mapping[str, Array]) -> None:
    if G.shape[1] != len(freqs):
        raise DimensionError(f"Quantify: responses at {G.shape[1]} frequencies need as many in freqs_hz, found {len(freqs)}.")
    if len(ids) != len(G) or len(set(ids)) != len(G):
        raise DimensionError(
            f"Quantify: needs one id for each of {len(G)} units, all different, found {len(ids)} ({', '.join(ids[:5])} ...)."
        )
    if len(G) < 2:
        raise DataError(f"Quantify: uncertainty of a population needs at least two units, found {len(G)}; record more units.")
    for name, value in [*zip(ids, G, strict=True), *others.items()]:
        if value.shape != G.shape[1:]:
            raise DimensionError(f"Quantify: candidate {name!r} should have the shape {G.shape[1:]}, found {value.shape}.")
        if not np.isfinite(value).all():
            at = freqs[int(np.argmin(np.isfinite(value).all(axis=(1, 2))))]
            raise DataError(f"Quantify: the response of {name!r} has NaN or infinity at {at:.6g} Hz; leave it or the frequency out.")
    double = set(ids) & set(others)
    if double:
        raise ConfigError(f"Quantify: candidates {sorted(double)} have names of units; give them others.")


def _nominal(nominal: Any, G: Array, others: Mapping[str, Array], names: tuple[str, ...], best: int) -> tuple[int, Array]:
    """Row of the nominal among units and candidates, -1 for a response of its own, and its response."""
    if nominal is not None and not isinstance(nominal, str) and np.ndim(nominal) > 0:
        response = np.asarray(nominal)
        if response.shape != G.shape[1:]:
            raise DimensionError(f"Quantify: the nominal's response should have the shape {G.shape[1:]}, found {response.shape}.")
        return -1, response
    if isinstance(nominal, str):
        if nominal not in names:
            raise ConfigError(f"Quantify: nominal {nominal!r} is not among {', '.join(names[:10])}.")
        nominal = names.index(nominal)
    index = best if nominal is None else int(nominal)
    if not 0 <= index < len(names):
        raise ConfigError(f"Quantify: nominal {index} is out of range for {len(names)} candidates.")
    return index, G[index] if index < len(G) else others[names[index]]
