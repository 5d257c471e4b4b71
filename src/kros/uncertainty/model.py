r"""What a quantification gives: a nominal, and a bound on how the units of the population differ from it.

Outputs and inputs are divided by the population's ranges first: with `S_y = diag(output_scale)`, `S_u =
diag(input_scale)` every response is `S_y^-1 G S_u`. Residuals, covers and weights live in these coordinates. In
physical units an output-side residual is `S_y E S_y^-1`, an input-side one `S_u E S_u^-1`, an additive one `S_y E
S_u^-1`, an inverse additive one `S_u E S_y^-1`: the weights act on scaled signals.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..core import AnyArray, Names, Record, StateSpace, Storable
from ..data import Shown
from .forms import Form
from .weights.cover import Cover, Weight


@dataclass(frozen=True, eq=False, kw_only=True)
class Uncertainty:
    """A bound on how the units of a population differ from a nominal one."""

    form: Form
    unit_ids: Names  # units that the weights cover
    nominal: int  # row of the nominal unit
    nominal_id: str
    freqs_hz: AnyArray  # (frequency,), Hz
    output_scale: AnyArray  # (p,)
    input_scale: AnyArray  # (m,)
    # (frequency,): largest residual over the other units for the best nominal of each form, and that of `form`
    bounds: dict[Form, AnyArray]
    nominals: dict[Form, str]  # unit behind each of these bounds
    cover: Cover  # optimal cover of the residuals, frequency by frequency
    weight: Weight
    misfit: AnyArray  # (unit, frequency): share of a unit that the form cannot rebuild; NaN near singular inverses
    remainder: Weight | None = None  # for `Gp - rebuilt(G, E)`, additive, where the form does not rebuild every unit

    @property
    def about(self) -> str:
        """Form, largest residual and order of the weights in a few words."""
        order = sum(self.weight.left_orders + self.weight.right_orders)
        return f"{self.form.value}, peak {self.peak_db[self.form]:.3g} dB, weights of order {order}"

    @property
    def peak_db(self) -> dict[Form, float]:
        """Peak of the bound of each form, dB; minus infinity where all units are alike."""
        with np.errstate(divide="ignore"):
            return {form: float(20 * np.log10(bound.max())) for form, bound in self.bounds.items()}

    @property
    def misfit_max(self) -> float:
        """Largest misfit where it is known; NaN where it is known nowhere."""
        known = self.misfit[np.isfinite(self.misfit)]
        return float(known.max()) if known.size else float("nan")

    @property
    def cover_max(self) -> float:
        """Largest `sigma_max(W_L^-1 E_k W_R^-1)` where it was verified; at most one."""
        return self.weight.cover_max

    @property
    def overbound_db_max(self) -> float:
        """Largest distance of the weight from the optimal cover, dB."""
        return self.weight.overbound_db_max


@dataclass(frozen=True, eq=False, kw_only=True)
class ResponseUncertainty(Uncertainty):
    """Weights that bound how measured responses differ from a nominal one, at the frequencies given and nowhere else.

    Parameters
    ----------
    nominal_response : ndarray, shape (frequency, p, m), complex
        In physical units.
    sample_period_s : float, s
    certificate : str
        Where the bound holds.

    Notes
    -----
    Local maxima of the bound that fall by more than 3 dB to a neighbouring frequency are named in the certificate: the
    grid does not resolve these peaks, which may be higher beside it. All other fields are those of `UncertainModel`.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.uncertainty import quantify
    >>> freqs_hz = np.geomspace(0.1, 40, 30)
    >>> lags = np.array([0.9, 1.0, 1.2])[:, None] / (1 + 1j * freqs_hz / 5)
    >>> found = quantify(lags[:, :, None, None], "additive", freqs_hz, sample_period_s=0.01)
    >>> found.nominal_id, found.cover_max <= 1
    ('1', True)
    """

    nominal_response: AnyArray
    sample_period_s: float
    certificate: str


@dataclass(frozen=True, eq=False, kw_only=True)
class UncertainModel(Shown, Uncertainty, Storable):
    """A nominal model and a bound on how the units of the population differ from it.

    Parameters
    ----------
    nominal_system : StateSpace
        In physical units.

    Notes
    -----
    ``bounds`` and ``nominals`` are the largest residuals of every form and the units behind them, ``weight`` has the
    diagonal systems ``left`` and ``right``, ``cover`` the magnitudes that no diagonal weight is below, ``misfit`` is
    what the form cannot rebuild of every unit, and ``remainder`` the weights of that; the rest is as in `quantify`.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.core import StateSpace
    >>> from kros.uncertainty import quantify
    >>> gains = np.array([0.9, 1.0, 1.2])[:, None, None]
    >>> units = StateSpace(np.full((3, 1, 1), 0.5), gains, np.ones((3, 1, 1)), np.zeros((3, 1, 1)), 0.01)
    >>> found = quantify(units, "output_multiplicative")
    >>> found.nominal_id, found.form.value, round(found.peak_db[found.form], 1)
    ('1', 'output_multiplicative', -14.0)
    """

    KIND = "uncertain_model"
    nominal_system: StateSpace

    def _summary_rows(self) -> Record:
        nominal = f"unit {self.nominal_id}, {self.nominal_system.n_states} states"
        return {
            "units": len(self.unit_ids),
            "nominal": nominal,
            "uncertainty": self.about,
            "residual over bound": self.cover_max,
            "bound above optimum": f"{self.overbound_db_max:.3g} dB",
            **{f"peak, {form.value}": f"{peak:.3g} dB" for form, peak in self.peak_db.items()},
        }

    @property
    def sample_period_s(self) -> float:
        """Sampling period, s."""
        return self.nominal_system.dt

    def scaled_nominal(self) -> StateSpace:
        """Return the nominal between scaled inputs and outputs, on which the weights act."""
        return self.nominal_system.multiplied(1 / self.output_scale, self.input_scale)
