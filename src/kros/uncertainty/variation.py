r"""Variation between units, and the estimation noise of recordings of finite length.

    bootstrapped models of every unit --responses--> draws (unit, draw, frequency)
    total(f) = mean over pairs of units   |E(G_k, G_i)|_F^2          what is seen: variation and noise of both estimates
    noise(f) = mean over pairs of draws   |E(G_i*, G_i**)|_F^2       what would be seen of identical units
    ratio(f) = noise / total

For the additive form the noise of both estimates adds to the squared difference, so the ratio is an unbiased comparison
of mean squares (the within over the total mean square of a one-way random-effects analysis of variance); for the other
forms it is one to first order in the residual. It scatters: with identical units around one, by about ``sqrt(2 / (units
- 1))`` and less. The share is the ratio cut at one.

What the bootstrap does not see is not in it: a bias that all episodes share counts as variation where it differs
between units.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.artifacts import check_shapes, load_artifact, loader, save_artifact
from ..core.errors import ConfigError, DataError
from ..core.frequency import check_grid
from ..core.small_matrices import sigma_max, squared
from ..identify import ModelSamples
from .forms import Form, as_form, residual
from .inputs import check_scale
from .settings import OUTLIER, SET

Array = npt.NDArray[Any]

_ARRAYS = ("freqs_hz", "residual", "total", "noise")


@dataclass(frozen=True, eq=False)
class VariationAndNoise:
    """Residuals of a population and the part of them that the recordings' finite length explains.

    Parameters
    ----------
    form : Form
    unit_ids : tuple of str
    nominal : int
        Row of the nominal unit.
    freqs_hz : ndarray, shape (frequency,), Hz
    residual : ndarray, shape (unit, frequency)
        Largest singular value of the residual against the nominal unit, in scaled coordinates.
    total, noise : ndarray, shape (frequency,)
        Mean squared Frobenius norms of residuals between units, and between resampled models of the same unit.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.identify import KoopmanMatrices, ModelSamples
    >>> from kros.uncertainty import variation_and_noise
    >>> poles = np.array([0.8, 0.9]).reshape(2, 1, 1)
    >>> draws = poles[:, None] + 0.001 * np.random.default_rng(0).normal(size=(2, 30, 1, 1))
    >>> estimate = KoopmanMatrices(poles, np.ones((2, 1, 1)))
    >>> samples = ModelSamples(("a", "b"), estimate, KoopmanMatrices(draws, np.ones((2, 30, 1, 1))))
    >>> found = variation_and_noise(samples, np.geomspace(0.1, 40, 20), 0.01)
    >>> found.residual.shape
    (2, 20)
    """

    form: Form
    unit_ids: tuple[str, ...]
    nominal: int
    freqs_hz: Array
    residual: Array
    total: Array
    noise: Array

    @property
    def ratio(self) -> Array:
        """Noise over total, shape (frequency,); above one where chance has it, zero where there is neither."""
        return np.divide(self.noise, self.total, out=np.where(self.noise > 0, np.inf, 0.0), where=self.total > 0)

    @property
    def noise_share(self) -> Array:
        """Share of the squared residual that estimation explains, shape (frequency,), within [0, 1]."""
        return np.minimum(self.ratio, 1.0)

    def save(self, folder: Path) -> None:
        """Write ``arrays.npz`` and ``variation_and_noise.json``."""
        content = {"form": self.form, "unit_ids": self.unit_ids, "nominal": self.nominal}
        save_artifact(Path(folder), "variation_and_noise", content, {name: getattr(self, name) for name in _ARRAYS})

    @classmethod
    @loader
    def load(cls, folder: Path) -> VariationAndNoise:
        """Read what `save` wrote."""
        content, arrays = load_artifact(Path(folder), "variation_and_noise")
        axes = {"freqs_hz": "f", "residual": "uf", "total": "f", "noise": "f"}
        check_shapes(arrays, axes, {"u": len(content["unit_ids"])}, Path(folder))
        facts = {name: arrays[name] for name in _ARRAYS} | {"nominal": content["nominal"]}
        return cls(form=Form(content["form"]), unit_ids=tuple(content["unit_ids"]), **facts)


def variation_and_noise(
    models: ModelSamples,
    freqs_hz: npt.ArrayLike,
    sample_period_s: float,
    form: Form | str = Form.ADDITIVE,
    *,
    nominal: int = 0,
    output_scale: npt.ArrayLike | None = None,
    input_scale: npt.ArrayLike | None = None,
) -> VariationAndNoise:
    """Compare the residuals between units with those between resampled models of the same unit.

    Parameters
    ----------
    models : ModelSamples
        Of at least two units, with at least two draws, as `kros.identify.bootstrap_edmd` gives them.
    freqs_hz : array_like, shape (frequency,), Hz
    sample_period_s : float, s
    form : Form or str
    nominal : int
        Row of the unit against which residuals are shown; the shares do not depend on it.
    output_scale, input_scale : array_like, shape (n,) and (m,), optional
        Ranges of lifted states and inputs, as in `ModelSet`; ones by default.

    Returns
    -------
    VariationAndNoise

    Raises
    ------
    DataError
        With fewer than two units or draws, or when a model is not finite.
    DimensionError
        When scales do not fit, or are not positive.
    ConfigError
        When the nominal is no unit, or the frequencies are no grid.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.identify import KoopmanMatrices, ModelSamples
    >>> from kros.uncertainty import variation_and_noise
    >>> poles = np.array([0.8, 0.9]).reshape(2, 1, 1)
    >>> draws = poles[:, None] + 0.001 * np.random.default_rng(0).normal(size=(2, 30, 1, 1))
    >>> estimate = KoopmanMatrices(poles, np.ones((2, 1, 1)))
    >>> samples = ModelSamples(("a", "b"), estimate, KoopmanMatrices(draws, np.ones((2, 30, 1, 1))))
    >>> found = variation_and_noise(samples, np.geomspace(0.1, 40, 20), 0.01)
    >>> bool((found.noise < found.total).all())  # these units differ by more than recordings of this length explain
    True
    """
    _require(models, nominal)
    form, freqs = as_form(form), check_grid(freqs_hz, sample_period_s)
    (units, draws, _, n), m = models.samples.A.shape, models.samples.B.shape[-1]
    scale = check_scale("output", output_scale, n)[:, None] / check_scale("input", input_scale, m)
    # Responses of the estimates, scaled: (unit, frequency, n, m).
    G = models.estimate.responses(freqs, sample_period_s) / scale
    noise = np.zeros(len(freqs))
    step = max(1, OUTLIER.at_once // (draws * n * max(n, m)))
    for row in range(units):
        for part in (slice(start, start + step) for start in range(0, len(freqs), step)):
            other = models.responses(row, freqs[part], sample_period_s) / scale  # (draw, frequency, n, m)
            noise[part] += _mean_square(residual(form, other, np.roll(other, 1, axis=0))) / units
    return VariationAndNoise(
        form=form,
        unit_ids=models.unit_ids,
        nominal=nominal,
        freqs_hz=freqs,
        residual=sigma_max(residual(form, G[nominal], G)),
        total=_between(form, G),
        noise=noise,
    )


def _mean_square(E: Array) -> Array:
    """Mean over the first axis of squared Frobenius norms, shape (frequency,)."""
    return np.asarray(squared(E).sum(axis=(-2, -1)).mean(axis=0))


def _between(form: Form, G: Array) -> Array:
    """Mean squared residual over ordered pairs of units, with at most 64 of them as nominals."""
    units = len(G)
    chosen = np.unique(np.linspace(0, units - 1, min(units, SET.nominals)).round().astype(int))
    return np.mean([_mean_square(residual(form, G[k], G)) for k in chosen], axis=0) * units / (units - 1)


def _require(models: ModelSamples, nominal: int) -> None:
    """Raise an error for too few units or draws, models that are not finite, or a nominal that is no unit."""
    (units, draws), what = models.samples.A.shape[:2], "Variation and noise"
    if units < 2 or draws < 2:
        raise DataError(f"{what}: needs at least two units and two draws of each, found {units} and {draws}.")
    parts = (models.estimate.A, models.estimate.B, models.samples.A, models.samples.B)
    finite = np.all([np.isfinite(part).reshape(units, -1).all(axis=1) for part in parts], axis=0)
    if not finite.all():
        unit = f"unit {models.unit_ids[int(finite.argmin())]} has a model or a draw that is not finite"
        raise DataError(f"{what}: {unit}; leave the unit out, or raise alpha.")
    if not 0 <= nominal < units:
        raise ConfigError(f"{what}: the nominal should be a row of {units} units, found {nominal}.")
