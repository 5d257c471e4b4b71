"""Fitted pykoop pipelines as models of kros: adopted, and compared with the pipeline before they are returned.

pipeline ── pykoop_formulas ──► lifted columns ── pykoop_coordinates ──► AdoptedModel ── the same predictions? ──► from_pykoop
"""

from __future__ import annotations

import keyword
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.errors import ConfigError, IdentificationError, MissingDependencyError
from .adopted import AdoptedModel
from .pykoop_coordinates import Reading, translate

Array = npt.NDArray[np.float64]

_AGREE = 1e-9  # largest difference from pykoop's prediction, relative to the largest prediction of the state
_ROWS = 200


def from_pykoop(pipeline: Any, *, states: Sequence[str] | None = None, inputs: Sequence[str] | None = None) -> AdoptedModel:
    """Adopt a fitted `pykoop.KoopmanPipeline`.

    Polynomials, radial basis functions, random Fourier features, delays, products with inputs, constants and affine scalers have formulas,
    also inside a `pykoop.SplitPipeline`. (To read pykoop's array of recordings, see `kros.data.from_pykoop`.)

    Parameters
    ----------
    pipeline : pykoop.KoopmanPipeline
        Fitted.
    states, inputs : sequence of str, optional
        Names for the formulas. Default: those of the frame that the pipeline was fitted to, else ``x0, x1, ...`` and ``u0, u1, ...``.

    Returns
    -------
    AdoptedModel

    Raises
    ------
    ConfigError
        A lifting function without a known formula, naming it; names that do not fit.
    IdentificationError
        A pipeline that is not fitted or has no regressor, a constant term that no shift removes, or predictions that differ from pykoop's
        by more than 1e-9 of the largest one.
    MissingDependencyError
        Without pykoop.

    Examples
    --------
    >>> import numpy as np
    >>> import pykoop
    >>> from kros.interop import from_pykoop
    >>> x = 0.9 ** np.arange(30)
    >>> X = np.column_stack([np.zeros(30), x, np.zeros(30)])  # episode, state, input
    >>> pipeline = pykoop.KoopmanPipeline(lifting_functions=None, regressor=pykoop.Edmd(alpha=1e-9)).fit(X, n_inputs=1, episode_feature=True)
    >>> round(float(from_pykoop(pipeline).A[0, 0]), 6)
    0.9
    """
    try:
        import pykoop
    except ImportError as error:
        raise MissingDependencyError(
            "from_pykoop needs pykoop, which is not installed; install it (pip install 'kros[pykoop]')."
        ) from error
    if not isinstance(pipeline, pykoop.KoopmanPipeline):
        raise ConfigError(f"from_pykoop: needs a pykoop.KoopmanPipeline, found {type(pipeline).__name__}; put it into a pipeline.")
    if not hasattr(pipeline, "regressor_fit_"):
        raise IdentificationError("from_pykoop: the pipeline is not fitted; call pipeline.fit(X, n_inputs=..., episode_feature=...) first.")
    names, input_names = _names(pipeline, states, inputs)
    model, reading = translate(pipeline, names, input_names)
    return _verified(model, pipeline, reading)


def _names(pipeline: Any, states: Sequence[str] | None, inputs: Sequence[str] | None) -> tuple[tuple[str, ...], tuple[str, ...]]:
    n, m = pipeline.n_states_in_, pipeline.n_inputs_in_
    own = getattr(pipeline, "feature_names_in_", None)
    columns = [str(name) for name in own][int(pipeline.episode_feature_) :] if own is not None else []
    x = tuple(states) if states is not None else tuple(columns[:n]) or tuple(f"x{i}" for i in range(n))
    u = tuple(inputs) if inputs is not None else tuple(columns[n:]) or tuple(f"u{i}" for i in range(m))
    bad = [name for name in (*x, *u) if not str(name).isidentifier() or keyword.iskeyword(name) or name == "pi"]
    if (len(x), len(u)) != (n, m) or bad or len({*x, *u}) < n + m or isinstance(states, str) or isinstance(inputs, str):
        raise ConfigError(
            f"from_pykoop: the pipeline has {n} states and {m} inputs, which need different names that a formula can hold, found states {x} and "
            f"inputs {u}; pass states=[...] and inputs=[...]."
        )
    return x, u


def _verified(model: AdoptedModel, pipeline: Any, reading: Reading) -> AdoptedModel:
    """Return the model with its disagreement in lifted and in original states, or refuse it."""
    import pykoop

    n, first = model.lifting.n_states, int(pipeline.episode_feature_)
    rng = np.random.default_rng(0)
    x = model.state_offset + reading.state_size(n) * rng.normal(size=(_ROWS, n))
    u = model.input_offset + reading.input_size * rng.normal(size=(_ROWS, len(model.inputs)))
    rows = np.concatenate([np.zeros((_ROWS, first)), x, u], axis=1)
    with pykoop.config_context(skip_validation=True):  # with it, no pipeline that was fitted to a frame predicts anything (pykoop 2.0.1)
        lifted, predicted = pipeline.transform(rows), np.asarray(pipeline.predict(rows))[:, first:]
    after = pipeline.regressor_.predict(lifted)[:, first:]
    theta, inputs = model.lift(x, u)
    # With delays pykoop's prediction is read from delayed features, which hold the past, in all rows but the last.
    last = slice(-1, None) if model.lifting.history else slice(None)
    together = slice(-min(len(theta), len(lifted)), None)
    pairs = {
        "lifted states": (theta[together], reading(lifted[together, first:])),
        "lifted prediction": ((theta @ model.A.T + inputs @ model.B.T)[together], reading(after[together])),
        "prediction": (model.predict(x, u)[last], predicted[last]),
    }
    differences = {what: _difference(ours, theirs) for what, (ours, theirs) in pairs.items()}
    worst = max(differences, key=lambda what: differences[what])
    if not max(differences.values()) <= _AGREE:  # also where it is not a number
        raise IdentificationError(
            f"from_pykoop: at {_ROWS} random rows the {worst} of the adopted model differ from pykoop's by {differences[worst]:.1e} of the largest, "
            f"allowed are {_AGREE:.0e}; identify the lifting {list(model.lifting.functions)} with kros instead."
        )
    return replace(model, disagreement=differences[worst])


def _difference(ours: Array, theirs: Array) -> float:
    """Return the largest difference relative to the largest value of the column; infinite where it is not a number."""
    largest = np.maximum(np.abs(theirs).max(axis=0), np.finfo(float).tiny)
    difference = float(np.max(np.abs(ours - theirs) / largest, initial=0.0))
    return difference if np.isfinite(difference) else np.inf
