"""Cross-validation of liftings and regularisation, grouped by episode or by unit.

    episodes --once--> triangular factors --restack all but a fold--> models for every alpha --> scores on the fold

Samples of one episode, and episodes of one unit, are alike: a model is never scored on an episode that it was fitted to, and where units
are left out, never on a unit.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import numpy.typing as npt

from ..core.errors import ConfigError, DataError, IdentificationError
from ..core.linalg import qr_triangle
from ..data.population import OUTLIERS, Population
from ..lifting import Lifting
from .edmd import KoopmanMatrices, edmd
from .episode_factors import Keys, reduce_episodes
from .factors import Factor, combine, lifted_factor
from .scores import Horizon, score_long_enough
from .selection import LeaveOut, Selection

log = logging.getLogger(__name__)
Array = npt.NDArray[np.float64]
_AT_ONCE = 16_000_000  # numbers of recordings, times alphas, in memory


def cross_validate(
    population: Population,
    keys: Keys,
    candidates: Mapping[str, Lifting],
    alphas: Sequence[float],
    parameters: Mapping[str, Array] | None = None,
    leave_out: LeaveOut | str = LeaveOut.EPISODES,
    folds: int | None = None,
    horizons: Sequence[Horizon] = (1, 100, None),
    stride: int = 10,
) -> Selection:
    """Score every candidate lifting at every alpha on recordings left out of the fit.

    Parameters
    ----------
    population : Population
        Units of the group "outliers" take no part.
    keys : mapping of str to sequence of EpisodeKey
        Training episodes of every unit; test episodes do not belong here.
    candidates : mapping of str to Lifting
    alphas : sequence of float
        Tikhonov coefficients, added to the unnormalised Gram matrix of what a fold leaves (see `edmd`).
    parameters : mapping of str to ndarray, shape (unit,), optional
        Values of the liftings' parameters, in the order of `keys`; every candidate takes those that it names.
    leave_out : LeaveOut or str
        ``episodes``: one model for every unit, fitted to its other episodes. ``units``: one model of all other units together, scored with
        the unit's own parameters.
    folds : int, optional
        Episode i of a unit, or unit i, belongs to fold ``i % folds``; 5 folds of episodes by default, and every unit by itself.
    horizons : sequence of int or None
        Samples ahead; None is the whole free run.
    stride : int
        Predictions ahead start at every `stride`-th sample.

    Returns
    -------
    Selection
        A pair for which no model can be made (dependent columns at ``alpha = 0``) has infinite errors, and the log says why.

    Raises
    ------
    ConfigError
        When candidates, alphas, folds or `leave_out` are missing or out of range, or a parameter is not given.
    DataError
        When a unit has fewer than two episodes, no units are left to fit, or every episode is too short for a horizon.
    """
    if leave_out not in list(LeaveOut):
        raise ConfigError(f"Cross-validation: leave_out = {leave_out!r} is unknown; use one of {', '.join(x.value for x in LeaveOut)}.")
    leave_out, horizons = LeaveOut(leave_out), tuple(horizons)
    parameters = {} if parameters is None else parameters
    _check(keys, candidates, alphas, parameters, folds)
    ids = tuple(keys)
    taking = [row for row, unit in enumerate(ids) if population.unit(unit).group != OUTLIERS]
    if len(taking) < len(ids):
        log.info("cross-validation leaves out units of the group %r: %s", OUTLIERS, sorted(set(ids) - {ids[row] for row in taking}))
    keys = {ids[row]: tuple(keys[ids[row]]) for row in taking}
    own = {name: np.asarray(values, dtype=float)[taking] for name, values in parameters.items()}
    member = _membership(keys, leave_out, folds)
    factors = reduce_episodes(population, keys, candidates)
    shape = (len(candidates), len(alphas), member.max() + 1, len(keys))
    full = (*shape, len(horizons), len(population.states))
    found = {name: np.full(full, np.nan) for name in ("percent", "rms", "r2")}
    radius = np.full(shape, np.nan)
    scored = np.stack([(member == fold).any(axis=1) for fold in range(shape[2])])
    for fold in range(shape[2]):
        models = [
            _fit(name, lifting, factors[name], own, member, fold, alphas, leave_out) for name, lifting in candidates.items()
        ]  # A (alpha, unit, n, n)
        for rows, data in _batches(population, keys, member == fold, len(alphas)):
            for c, lifting in enumerate(candidates.values()):
                _score_rows(found, (c, fold), models[c], lifting, own, rows, data, horizons, stride)
        for c, model in enumerate(models):
            radius[c, :, fold, scored[fold]] = _radius(model.A[:, scored[fold]]).T
    unknown = [horizon for h, horizon in enumerate(horizons) if np.isnan(found["rms"][..., h, :]).all()]
    if unknown:
        raise DataError(f"Cross-validation: no episode is long enough for horizons {unknown}; ask for shorter ones.")
    return Selection(
        leave_out=leave_out,
        candidates=tuple(candidates),
        n_lifted=tuple(lifting.n_lifted for lifting in candidates.values()),
        alphas=tuple(float(a) for a in alphas),
        unit_ids=tuple(keys),
        states=population.states,
        horizons=horizons,
        scored=scored,
        spectral_radius=radius,
        **found,
    )


def _check(
    keys: Keys, candidates: Mapping[str, Lifting], alphas: Sequence[float], parameters: Mapping[str, Array], folds: int | None
) -> None:
    if not candidates or not len(alphas) or not (np.isfinite(alphas).all() and min(alphas) >= 0) or (folds is not None and folds < 2):
        raise ConfigError(
            f"Cross-validation: needs candidates, alphas of zero or more and at least two folds, found {list(candidates)}, alphas "
            f"{list(alphas)}, folds = {folds}."
        )
    for name, lifting in candidates.items():
        for parameter in lifting.parameters:
            found = np.shape(parameters[parameter]) if parameter in parameters else None
            if found != (len(keys),):
                raise ConfigError(
                    f"Cross-validation: candidate {name!r} needs {parameter!r} of shape ({len(keys)},), one value a unit, found {found}; "
                    "calibrate the units first."
                )


def _membership(keys: Keys, leave_out: LeaveOut, folds: int | None) -> npt.NDArray[np.int64]:
    """Fold of every episode, shape (unit, episode); -1 where a unit has fewer episodes than others."""
    most = max((len(episodes) for episodes in keys.values()), default=0)
    member = np.full((len(keys), most), -1)
    for row, (unit, episodes) in enumerate(keys.items()):
        if len(episodes) < (2 if leave_out is LeaveOut.EPISODES else 1):
            raise DataError(
                f"Cross-validation by {leave_out.value}: unit {unit} has {len(episodes)} training episodes; record more, or leave it out."
            )
        at = np.arange(len(episodes)) if leave_out is LeaveOut.EPISODES else np.full(len(episodes), row)
        member[row, : len(episodes)] = at % (folds or (5 if leave_out is LeaveOut.EPISODES else len(keys)))
    if not keys or (leave_out is LeaveOut.UNITS and len(keys) < 2):
        raise DataError(f"Cross-validation by {leave_out.value}: {len(keys)} units take part, which leaves none to fit; give more units.")
    return member


def _fit(
    name: str,
    lifting: Lifting,
    factors: Factor,
    parameters: Mapping[str, Array],
    member: npt.NDArray[np.int64],
    fold: int,
    alphas: Sequence[float],
    leave_out: LeaveOut,
) -> KoopmanMatrices:
    """Models of a candidate without one fold, A (alpha, unit, n, n); nan where there is none."""
    own = {parameter: parameters[parameter] for parameter in lifting.parameters}
    keep = (member >= 0) & (member != fold)
    kept = Factor(factors.R * keep[..., None, None], factors.peak * keep[..., None], factors.n_samples * keep)
    R = lifted_factor(combine(kept), lifting, own, lifting).R
    if leave_out is LeaveOut.UNITS:
        R = qr_triangle(R.reshape(1, -1, R.shape[-1]))
    n, p = lifting.n_lifted, R.shape[-1] - lifting.n_lifted
    W = np.full((len(alphas), len(R), n, p), np.nan)
    for a, unit in np.ndindex(W.shape[:2]):
        try:
            model = edmd(R[unit], n, alphas[a])
        except IdentificationError as error:
            log.warning("candidate %s, alpha %g, fold %d, unit number %d: %s", name, alphas[a], fold, unit, error)
            continue
        W[a, unit] = np.concatenate([model.A, model.B], axis=-1)
    W = np.broadcast_to(W, (len(alphas), len(member), n, p))
    return KoopmanMatrices(W[..., :n], W[..., n:])


def _batches(
    population: Population, keys: Keys, wanted: npt.NDArray[np.bool_], repeats: int
) -> Iterator[tuple[list[int], list[tuple[Array, Array]]]]:
    """Read the wanted episodes, as many whole units at a time as memory allows; yields their units' rows and the data."""
    rows: list[int] = []
    data: list[tuple[Array, Array]] = []
    for row, episodes in enumerate(keys.values()):
        for column, key in enumerate(episodes):
            if wanted[row, column]:
                rows.append(row)
                data.append(population.read_parts(key))
        if rows and repeats * sum(x.size + u.size for x, u in data) > _AT_ONCE:
            yield rows, data
            rows, data = [], []
    if rows:
        yield rows, data


def _score_rows(
    found: dict[str, Array],
    place: tuple[int, int],
    models: KoopmanMatrices,
    lifting: Lifting,
    parameters: Mapping[str, Array],
    rows: list[int],
    data: list[tuple[Array, Array]],
    horizons: Sequence[Horizon],
    stride: int,
) -> None:
    """Score all alphas on some episodes side by side, and fill in the means over each unit's episodes."""
    c, fold = place
    alphas = len(models.A)
    flat = KoopmanMatrices(*(m[:, rows].reshape(-1, *m.shape[2:]) for m in (models.A, models.B)))
    own = {name: np.tile(parameters[name][rows], alphas) for name in lifting.parameters}
    scores = score_long_enough(flat, lifting, own, data * alphas, horizons, stride)
    counted = (scores.counts > 0).reshape(alphas, len(rows), -1, 1)
    for name, whole in found.items():
        values = getattr(scores, name).reshape(alphas, len(rows), *whole.shape[4:])
        for row in dict.fromkeys(rows):
            own_rows = [i for i, r in enumerate(rows) if r == row]
            count = counted[:, own_rows].sum(axis=1)
            total = np.where(counted[:, own_rows], values[:, own_rows], 0.0).sum(axis=1)
            whole[c, :, fold, row] = np.divide(total, count, out=np.full(total.shape, np.nan), where=count > 0)


def _radius(A: Array) -> Array:
    """Spectral radius, nan where there is no model."""
    known = np.asarray(np.isfinite(A).all(axis=(-1, -2)))
    values = np.abs(np.linalg.eigvals(np.where(known[..., None, None], A, 0.0))).max(axis=-1)
    return np.where(known, values, np.nan)
