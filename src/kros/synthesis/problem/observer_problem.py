r"""The observer problem: nominal model, uncertainty weights, noise; and the error system that K shapes.

With uncertainty of any of the six forms, ``E = W_L Delta W_R`` on scaled signals, and an optional additive remainder
:math:`R = W_{rL} \Delta_r W_{rR}`, the estimation error ``e = x - x_hat`` is

.. math:: e = T_e W_L\,\Delta (I - N \Delta)^{-1} M w_1 + S R\,W_u w_1 \; - \; S\,(zI - A)^{-1} J K\, n

with :math:`S = (I + (zI - A)^{-1} J K C)^{-1}` and ``J = B`` (input injection) or ``J = I`` (state injection). ``T_e``
is ``S`` or ``S G``, and M and N, which do not contain K, depend on the form. K is outside the loop of :math:`\Delta`,
so no choice of K can lose robustness, and none can gain it: the set is well posed when ``||N|| < 1``. The generalized
plant is drawn in `plants`. With ``G`` the nominal model from input to state and ``w2 = Delta z2``,

::

                        +-------------- inverse ---------------+
                        v                                      |
     u' ------+------->(+)--> W_R --> z2 --> Delta --> w2 --> W_L --+--> at the input:  x = G (u' + W_L w2)
              |         ^                                           |
              +--> G ---+   (sees the state)                        +--> at the state:  x = G u' + W_L w2

=============================  =========  ========  =======  =====  ===============  ===========  =====================
form                           acts at    sees      inverse  T_e    M                N            robust when
=============================  =========  ========  =======  =====  ===============  ===========  =====================
additive                       state      input     no       S      W_R W_u          0            always
input multiplicative           input      input     no       S G    W_R W_u          0            always
output multiplicative          state      state     no       S      W_R G W_u        0            always
inverse additive               input      state     yes      S G    W_R G W_u        W_R G W_L    ``||N|| < 1``
inverse input multiplicative   input      input     yes      S G    W_R W_u          W_R W_L      ``||N|| < 1``
inverse output multiplicative  state      state     yes      S      W_R G W_u        W_R W_L      ``||N|| < 1``
=============================  =========  ========  =======  =====  ===============  ===========  =====================

Everything numerical happens in scaled coordinates: states over `output_scale`, inputs over `input_scale`, measurements
over their noise.

Symbols
-------
A, B, C : nominal model, state = full lifted state;  J : injection matrix;  d, r, n : disturbance of the input, of the
    state, noise
"""

from __future__ import annotations

from functools import cached_property, partial
from typing import TYPE_CHECKING

import numpy as np

from ...core import AGREED, TINY, AnyArray, DimensionError, StateSpace, SynthesisError, frozen, gain, hinf_norm, member
from ...uncertainty.forms import Form, as_form
from ..assumptions import require_detectable
from ..generalized_plant import GeneralizedPlant, Sum, interconnect
from ..result import Injection

if TYPE_CHECKING:
    from ...identify.model_set import ModelSet
    from ...uncertainty.model import UncertainModel

_WEIGHTS = ("W_L", "W_R", "W_u", "remainder_left", "remainder_right")


@frozen
class ObserverProblem:
    """What an observer must be good at: a nominal model, an uncertain set around it, measurement noise.

    Raises
    ------
    DimensionError
        When sizes or sampling periods do not fit, or a scale or noise level is not positive.

    Examples
    --------
    >>> from kros.core import StateSpace, gain
    >>> from kros.synthesis import ObserverProblem
    >>> lag, W_L, W_R = StateSpace([[0.5]], [[1.0]], [[1.0]], [[0.0]], 0.01), gain([[0.1]], 0.01), gain([[1.0]], 0.01)
    >>> problem = ObserverProblem(lag, [[1.0]], W_L, W_R, input_scale=[1.0], output_scale=[1.0], noise=[0.1])
    >>> problem.form.value, problem.injection.value
    ('inverse_input_multiplicative', 'state')
    """

    nominal: StateSpace  # only A (n, n), B (n, m) and dt are used, the state being the full lifted state
    C: AnyArray  # (q, n), selects the measured outputs from the lifted state
    W_L: StateSpace  # left weight of ``E = W_L Delta W_R`` on scaled signals, stable; as many outputs as E has rows
    W_R: StateSpace  # right weight, stable; as many inputs as E has columns
    input_scale: AnyArray  # (m,), physical size of each input
    output_scale: AnyArray  # (n,), physical size of each (lifted) state
    noise: AnyArray  # (q,), standard deviation of the white measurement noise per sample, in the units of y
    n_original: int | None = None  # so many first states are the original ones, whose errors count; default all
    W_u: StateSpace | None = None  # (m, m), of the scaled inputs; default white inputs of unit variance
    remainder_left: StateSpace | None = None  # (n, n), left weight of the additive remainder on scaled states
    remainder_right: StateSpace | None = None  # (m, m), right weight of it on scaled inputs
    injection: Injection = Injection.STATE  # where the correction enters
    form: Form = Form.INVERSE_INPUT_MULTIPLICATIVE  # of the uncertainty, or its name

    def __post_init__(self) -> None:
        put = partial(object.__setattr__, self)
        put("form", as_form(self.form))
        put("injection", member(Injection, self.injection, "Observer problem: the injection"))
        put("nominal", StateSpace.of(self.nominal))
        put("C", np.atleast_2d(np.asarray(self.C, dtype=float)))
        n, m, q, kept = self.nominal.n_states, self.nominal.n_inputs, len(self.C), self.n_original
        self._require(self.C.shape[1] == n, f"C should be (q, {n}) for {n} lifted states, found {self.C.shape}")
        self._require(kept is None or 1 <= kept <= n, f"n_original = {kept} should lie between 1 and {n}")
        for name, size in (("input_scale", m), ("output_scale", n), ("noise", q)):
            value = np.atleast_1d(np.asarray(getattr(self, name), dtype=float))
            valid = value.shape == (size,) and bool(np.all(np.isfinite(value) & (value >= TINY)))
            self._require(valid, f"{name} should be {size} positive numbers, found {value}")
            put(name, value)
        one = (self.remainder_left is None) != (self.remainder_right is None)
        self._require(self.injection is not Injection.NONE, "injection should be INPUT or STATE, found NONE")
        self._require(not one, "remainder_left and remainder_right come together, found only one of them")
        self._check_weights()

    def _require(self, condition: bool, message: str) -> None:
        if not condition:
            raise DimensionError(f"Observer problem: {message}.")

    def _check_weights(self) -> None:
        """Refuse weights whose sizes or sampling periods do not fit; None is any size."""
        n, m, dt = self.nominal.n_states, self.nominal.n_inputs, self.nominal.dt
        rows, columns = self.form.sizes(n, m)
        sizes = (rows, None), (None, columns), (m, m), (n, None), (None, m)
        for name, (height, width) in zip(_WEIGHTS, sizes, strict=True):
            if getattr(self, name) is not None:
                weight = StateSpace.of(getattr(self, name))
                object.__setattr__(self, name, weight)
                found = (*weight.batch_shape, weight.n_outputs, weight.n_inputs)
                wanted = f"{name} should be {height or 'any'} x {width or 'any'} for {self.form.value} uncertainty"
                fits = found == (height or found[0], width or found[-1])
                self._require(fits, f"{wanted}, found {' x '.join(map(str, found))}")
                self._require(weight.dt == dt, f"{name} is sampled at {weight.dt} s, the nominal model at {dt} s")

    @classmethod
    def from_uncertain(cls, models: ModelSet, uncertain: UncertainModel, noise: AnyArray) -> ObserverProblem:
        """Return the problem of the nominal unit and the set around it, remainder included.

        Parameters
        ----------
        models : ModelSet
            The models that were quantified, in the recordings' units or divided by their ranges.
        uncertain : UncertainModel
        noise : ndarray, shape (q,)
            Standard deviation of every measurement's noise, in the units of `models`.

        Raises
        ------
        SynthesisError
            When the nominal is none of the models' units, or not the model that the set surrounds.
        DimensionError
            When the noise does not fit the measured channels.
        """
        unit, remainder = uncertain.nominal_id, uncertain.remainder
        if unit not in models.unit_ids:
            problem = f"the nominal {unit!r} is none of the models' units"
            raise SynthesisError(f"Observer problem: {problem}; quantify with one of them as nominal.")
        case = cls(
            nominal=models.systems([unit])[0],
            C=np.eye(models.lifting.n_lifted)[list(models.measured)],
            W_L=uncertain.weight.left,
            W_R=uncertain.weight.right,
            input_scale=models.input_scale,
            output_scale=models.output_scale,
            noise=noise,
            n_original=models.lifting.n_states,
            remainder_left=getattr(remainder, "left", None),
            remainder_right=getattr(remainder, "right", None),
            form=uncertain.form,
        )
        freqs = uncertain.freqs_hz[:: max(1, len(uncertain.freqs_hz) // 8)]
        expected, own = (s.frequency_response(freqs) for s in (uncertain.scaled_nominal(), case.scaled_model))
        if own.shape != expected.shape or np.abs(own - expected).max() > AGREED * np.abs(expected).max():
            problem = f"the model of {unit!r} is not the nominal that the uncertain set surrounds"
            raise SynthesisError(f"Observer problem: {problem}; quantify these very models.")
        return case

    @property
    def input_weight(self) -> StateSpace:
        """W_u, the identity unless given."""
        return self.W_u if self.W_u is not None else gain(np.eye(self.nominal.n_inputs), self.nominal.dt)

    @property
    def remainder(self) -> tuple[StateSpace, StateSpace] | None:
        """Weights of the additive remainder, for what it does and for what it sees of white inputs."""
        left, right = self.remainder_left, self.remainder_right
        return None if left is None or right is None else (left, right @ self.input_weight)

    @cached_property
    def scaled(self) -> tuple[AnyArray, AnyArray, AnyArray, AnyArray]:
        """A, B, C and the selection W_p of the original states, scaled; the measurement noise has unit covariance."""
        x, u = self.output_scale, self.input_scale
        A, B = self.nominal.A * x / x[:, None], self.nominal.B * u / x[:, None]
        return A, B, self.C * x / self.noise[:, None], np.eye(len(A))[: self.n_original]

    @cached_property
    def scaled_model(self) -> StateSpace:
        """G, from scaled inputs to scaled states."""
        A, B, _, _ = self.scaled
        return StateSpace(A, B, np.eye(len(A)), np.zeros_like(B), self.nominal.dt)

    @cached_property
    def M(self) -> StateSpace:  # noqa: N802
        """From the disturbance w1 to what Delta sees."""
        seen = self.input_weight
        return self.W_R @ (seen if self.form.sees_input else self.scaled_model @ seen)

    @cached_property
    def N(self) -> StateSpace:  # noqa: N802
        """From what Delta does to what it sees; zero for the forms without a loop."""
        form, G = self.form, self.scaled_model
        if not form.inverse:
            return gain(np.zeros((self.W_R.n_outputs, self.W_L.n_inputs)), self.nominal.dt)
        return self.W_R @ (self.W_L if form.at_input is form.sees_input else G @ self.W_L)

    @property
    def injection_matrix(self) -> AnyArray:
        """J in scaled coordinates: the correction enters through the inputs or on the state itself."""
        A, B, _, _ = self.scaled
        return B if self.injection is Injection.INPUT else np.eye(len(A))

    @property
    def nothing(self) -> StateSpace:
        """The controller that corrects nothing."""
        return gain(np.zeros((self.injection_matrix.shape[1], len(self.C))), self.nominal.dt)

    def require_sound(self) -> None:
        """Check that the set is well posed and the observer possible.

        Raises
        ------
        SynthesisError
            For an unstable nominal model or weight, an undetectable pair, or ``||N|| >= 1``.
        """
        if self.nominal.dt == 0:
            raise SynthesisError("Observer synthesis works in discrete time, found a continuous model; sample it.")
        require_detectable(self.nominal.A, self.C, self.nominal.dt, "Observer synthesis")
        for name in ("nominal", *_WEIGHTS):
            system = getattr(self, name)
            if isinstance(system, StateSpace) and not system.is_stable():
                radius = f"{name} has spectral radius {float(system.spectral_radius()):.9g}"
                raise SynthesisError(f"Observer synthesis: {radius}; it must be below 1, use a stable model.")
        size = hinf_norm(self.N)
        if size >= 1:
            raise SynthesisError(
                f"Observer synthesis: ||N|| = {size:.6g} should be below 1 for "
                f"{self.form.value.replace('_', ' ')} uncertainty, otherwise the set contains ill-posed "
                "plants; choose another form or nominal, or leave outliers out."
            )

    def error_plant(self) -> GeneralizedPlant:
        """Unweighted error system, scaled.

        w = (d, r, n), z = W_p e, y = C e + n; d acts at the input, r at the state.
        """
        A, B, C, W_p = self.scaled
        n, m, q, J = len(A), B.shape[1], len(C), self.injection_matrix
        B1 = np.hstack([B, np.zeros((n, n + q))])
        D11 = np.pad(W_p, ((0, 0), (m, q)))
        D21 = np.hstack([np.zeros((q, m)), C, np.eye(q)])
        D12, D22 = (np.zeros((rows, J.shape[1])) for rows in (len(W_p), q))
        return GeneralizedPlant(A, B1, -J, W_p, C, D11, D12, D21, D22, self.nominal.dt)

    def error_system(self, controller: StateSpace) -> StateSpace:
        """Closed error system from (d, r, n), scaled, to W_p e, for a controller in physical units."""
        return self.error_plant().close(self.to_scaled(controller))

    def estimate_error(self, estimate: StateSpace) -> StateSpace:
        """Error system from (d, r, n, s), scaled, to W_p e, for an estimate that nothing is fed back to.

        ``e = x - F [C x + n; x; s]``, ``x = G (s + d) + r``; F from measurements, states (for functions of what is
        measured) and inputs to all states, in physical units.
        """
        A, B, C, W_p = self.scaled
        n, m, q, eye = len(A), B.shape[1], len(C), np.eye
        truth = np.vstack([C, eye(n), np.zeros((m, n))])
        columns = {"n": eye(q + n + m, q), "s": eye(q + n + m)[:, q + n :]}
        wires: dict[str, Sum] = {"plant": {"d": 1.0, "s": 1.0}, "F": {"plant": truth, "r": truth} | columns}
        inputs, outputs = {"d": m, "r": n, "n": q, "s": m}, {"z": {"plant": W_p, "r": W_p, "F": -W_p}}
        blocks = {"plant": self.scaled_model, "F": self.scaled_estimate(estimate)}
        return interconnect(blocks, wires, inputs, outputs)

    def scaled_estimate(self, estimate: StateSpace) -> StateSpace:
        """Turn an estimate of all states from measurements, states and inputs into scaled coordinates."""
        sizes = np.concatenate([self.noise, self.output_scale, self.input_scale])
        return estimate.multiplied(1 / self.output_scale, sizes)

    @property
    def correction_scale(self) -> AnyArray:
        """Physical size of each correction."""
        return self.input_scale if self.injection is Injection.INPUT else self.output_scale

    def to_scaled(self, controller: StateSpace) -> StateSpace:
        """Turn a controller in physical units into one in scaled coordinates."""
        return controller.multiplied(1 / self.correction_scale, self.noise)

    def to_physical(self, controller: StateSpace) -> StateSpace:
        """Turn a controller in scaled coordinates into one in physical units."""
        return controller.multiplied(self.correction_scale, 1 / self.noise)
