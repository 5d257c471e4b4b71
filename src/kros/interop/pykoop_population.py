"""One pykoop pipeline for each unit as the models of a population, ready for uncertainty and synthesis."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.errors import ConfigError, DataError
from ..data import Population
from ..identify import ModelSet
from .adopted import AdoptedModel
from .pykoop import from_pykoop

Array = npt.NDArray[np.float64]


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
    facts = [_facts(model, population, unit, condition) for unit, model in adopted.items()]
    n = lifting.n_lifted
    peak = np.max([f[0] for f in facts], axis=0)
    return ModelSet(
        name="pykoop",
        condition=condition,
        lifting=lifting,
        channels=population.channels,
        sample_period_s=population.sample_period_s,
        unit_ids=tuple(adopted),
        A=np.stack([model.A for model in models]),
        B=np.stack([model.B for model in models]),
        parameters={},
        residual_covariance=np.stack([f[1] for f in facts]),
        output_scale=peak[:n],
        input_scale=peak[n:],
        longest_s=max(len(population.read(key)) for unit in adopted for key in population.keys(unit, condition))
        * population.sample_period_s,
        status=tuple("ok" if np.abs(np.linalg.eigvals(model.A)).max() < 1 else "unstable" for model in models),
    )


def _facts(model: AdoptedModel, population: Population, unit: str, condition: str) -> tuple[Array, Array]:
    """Return the largest magnitude of every lifted state and input, and the covariance of the one-step residual."""
    peaks, total, count = [], np.zeros_like(model.A), 0
    for key in population.keys(unit, condition):
        lifted, inputs = model.lift(*population.read_parts(key))
        residual = lifted[1:] - lifted[:-1] @ model.A.T - inputs[:-1] @ model.B.T
        peaks.append(np.abs(np.concatenate([lifted, inputs], axis=1)).max(axis=0))
        total += residual.T @ residual
        count += len(residual)
    return np.max(peaks, axis=0), total / max(count, 1)
