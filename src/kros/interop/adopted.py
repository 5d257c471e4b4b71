"""A lifted model that was fitted by another package: formulas, matrices, and the offsets that it takes deviations from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ..core.errors import DimensionError
from ..core.lti import StateSpace
from ..identify import free_run
from ..lifting import Lifting

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class AdoptedModel:
    """A fitted pykoop pipeline as a model of kros, in deviations from an offset.

    Parameters
    ----------
    lifting : Lifting
        Of ``x - state_offset``; its names are those of the states.
    inputs : tuple of str
    A : ndarray, shape (n_lifted, n_lifted)
    B : ndarray, shape (n_lifted, n_lifted_inputs)
    state_offset : ndarray, shape (n_states,)
        Zero for pipelines that centre nothing.
    input_offset : ndarray, shape (n_inputs,)
    disagreement : float
        Largest difference from pykoop's one-step prediction at random rows, relative to the largest prediction of the state.

    Examples
    --------
    >>> import numpy as np
    >>> import pykoop
    >>> from kros.interop import from_pykoop
    >>> X = np.column_stack([np.zeros(30), 0.9 ** np.arange(30), np.zeros(30)])  # episode, state, input
    >>> model = from_pykoop(pykoop.KoopmanPipeline(regressor=pykoop.Edmd(alpha=1e-9)).fit(X, n_inputs=1, episode_feature=True))
    >>> model.lifting.states, model.inputs, model.disagreement < 1e-9
    (('x0',), ('u0',), True)
    """

    lifting: Lifting
    inputs: tuple[str, ...]
    A: Array
    B: Array
    state_offset: Array
    input_offset: Array
    disagreement: float = float("nan")

    def predict(self, x: npt.ArrayLike, u: npt.ArrayLike | None = None) -> Array:
        """Predict one step.

        Parameters
        ----------
        x : array_like, shape (..., n_states), or (..., n_samples, n_states) for a lifting with delays
            In the units of the recording, without any offset taken off. With delays: consecutive samples.
        u : array_like, of the same shape but n_inputs, optional
            Not needed by models without inputs.

        Returns
        -------
        ndarray, shape (..., n_states), or (..., n_samples - history, n_states)
            Samples one step later; with delays, the first one follows the first complete history.
        """
        x, n = np.asarray(x, dtype=float), self.lifting.n_states
        theta, inputs = self.lift(x, np.zeros((*x.shape[:-1], 0)) if u is None else u)
        return np.asarray(theta @ self.A[:n].T + inputs @ self.B[:n].T + self.state_offset)

    def lift(self, x: npt.ArrayLike, u: npt.ArrayLike) -> tuple[Array, Array]:
        """Return lifted states and lifted inputs of samples, as in `predict`; both are of deviations from the offsets."""
        xi, mu = np.asarray(x, dtype=float), np.asarray(u, dtype=float)
        if mu.shape != (*xi.shape[:-1], len(self.inputs)):
            raise DimensionError(
                f"AdoptedModel: states of shape {xi.shape} need a row each of the inputs {self.inputs}, found shape {mu.shape}."
            )
        xi, mu, h = xi - self.state_offset, mu - self.input_offset, self.lifting.history
        windows = self.lifting.windows(xi, mu)
        return self.lifting.lift(windows), self.lifting.lift_inputs(mu[..., h:, :] if h else mu, windows)

    def free_run(self, x0: npt.ArrayLike, u: npt.ArrayLike) -> Array:
        """Simulate from first states with recorded inputs, retracted and re-lifted at every step.

        Parameters
        ----------
        x0 : array_like, shape (..., n_states), or (..., history + 1, n_states) for a lifting with delays
        u : array_like, shape (..., n_samples, n_inputs)

        Returns
        -------
        ndarray, shape (..., n_samples, n_states)
            The first samples are `x0`.
        """
        inputs = np.asarray(u, dtype=float) - self.input_offset
        first = np.asarray(x0, dtype=float) - self.state_offset
        batch = inputs.shape[:-2]
        first, inputs = first.reshape(-1, *first.shape[len(batch) :]), inputs.reshape(-1, *inputs.shape[-2:])
        run = free_run(self.A, self.B, self.lifting, {}, first, inputs)
        return np.asarray(run.reshape(*batch, *run.shape[1:]) + self.state_offset)

    def system(self, sample_period_s: float) -> StateSpace:
        """Return the model as a linear system from (lifted) input deviations to lifted states."""
        n, m = self.B.shape
        return StateSpace(self.A, self.B, np.eye(n), np.zeros((n, m)), sample_period_s)
