"""One pykoop pipeline for each unit as the models of a population, ready for uncertainty and synthesis."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..core.errors import ConfigError, DataError
from ..data import Population
from ..identify import KoopmanMatrices, ModelSet, combine, episode_factors
from ..identify.edmd import residual_covariance
from ..identify.ranges import Ranges
from .pykoop import from_pykoop


def models_from_pykoop(pipelines: Mapping[str, Any], population: Population, *, condition: str | None = None) -> ModelSet:
    """Adopt one fitted pipeline for each unit of a population, for uncertainty and synthesis.

    Parameters
    ----------
    pipelines : mapping of str to pykoop.KoopmanPipeline
        By unit, fitted to the channels of the population in their order, all with the same lifting functions and none that centres.
    population : Population
        Gives names, ranges and one-step residuals.
    condition : str, optional
        Default: the first.

    Returns
    -------
    ModelSet

    Raises
    ------
    DataError
        A unit that the population does not have in this condition.
    ConfigError
        Pipelines with different lifting functions, or with offsets.

    Examples
    --------
    >>> import numpy as np
    >>> import pykoop
    >>> import kros
    >>> from kros.interop import models_from_pykoop
    >>> motors = kros.plants.DcMotorPopulation(n_units=2, n_episodes=2, seconds=1.0, seed=3).simulate().population
    >>> pipelines = {}
    >>> for unit in motors.unit_ids:
    ...     pipeline = pykoop.KoopmanPipeline(regressor=pykoop.Edmd(alpha=1e-6))
    ...     pipelines[unit] = pipeline.fit(kros.data.to_pykoop(motors, unit), n_inputs=1, episode_feature=True)
    >>> models_from_pykoop(pipelines, motors).A.shape
    (2, 3, 3)
    """
    condition = population.conditions[0] if condition is None else condition
    adopted = {unit: from_pykoop(p, states=population.states, inputs=population.inputs) for unit, p in pipelines.items()}
    missing = [unit for unit in adopted if not population.keys(unit, condition)]
    if missing or not adopted:
        raise DataError(
            f"models_from_pykoop: pipelines of units {list(adopted)}, the population has {list(population.unit_ids)} and no episodes of "
            f"{missing} in condition {condition!r}; name the units as in the population."
        )
    models = list(adopted.values())
    lifting = models[0].lifting
    odd = [unit for unit, model in adopted.items() if model.lifting != lifting]
    centred = [unit for unit, model in adopted.items() if np.any(model.state_offset) or np.any(model.input_offset)]
    if odd or centred:
        raise ConfigError(
            f"models_from_pykoop: models of a population share one lifting, of the channels as they are; units {odd} have other functions than "
            f"{next(iter(adopted))}, units {centred} are centred; scale with MaxAbsScaler (or with_mean=False), or transform the recordings before."
        )
    each = episode_factors(population, {unit: population.keys(unit, condition) for unit in adopted}, lifting)
    factor, matrices = combine(each), KoopmanMatrices(*(np.stack([getattr(model, name) for model in models]) for name in "AB"))
    ranges = Ranges.of(factor, lifting.n_lifted)
    return ModelSet(
        name="pykoop",
        condition=condition,
        lifting=lifting,
        channels=population.channels,
        sample_period_s=population.sample_period_s,
        unit_ids=tuple(adopted),
        A=matrices.A,
        B=matrices.B,
        parameters={},
        residual_covariance=residual_covariance(factor.R, lifting.n_lifted, matrices, factor.n_samples),
        output_scale=ranges.outputs,
        input_scale=ranges.inputs,
        longest_s=int(each.n_samples.max()) * population.sample_period_s,
        status=tuple("ok" if radius < 1 else "unstable" for radius in matrices.spectral_radius()),
    )
