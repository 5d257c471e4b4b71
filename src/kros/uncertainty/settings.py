"""Settings of quantification: form, nominal, order and outliers; and how weights are fitted and checked."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from pydantic import Field

from ..core import ITERATED, ROUNDING, Settings

FORMS = Literal[
    "additive",
    "input_multiplicative",
    "output_multiplicative",
    "inverse_additive",
    "inverse_input_multiplicative",
    "inverse_output_multiplicative",
]


class WeightSettings(Settings):
    """How weights are fitted."""

    max_order: int = Field(4, ge=0, description="largest order of an entry of a weight")
    tolerance_db: float = Field(1.0, ge=0, description="how far a weight may be above the bound of the residuals")


class UncertaintySettings(Settings):
    """Uncertainty model and outlier scores: the keys of a study."""

    form: FORMS = Field("inverse_input_multiplicative", description="of the uncertain set")
    n_freqs: int = Field(1000, ge=50, le=100_000, description="points of the frequency grid")
    outlier_form: FORMS = Field("additive", description="of the residuals that outlier scores are made of")


class QuantifySettings(UncertaintySettings, WeightSettings):
    """What `kros.quantify` takes beside models; a study has the defaults of what is no key of it."""

    nominal: str | None = Field(None, description="a unit; by default the one with the lowest peak residual")
    false_alarm_rate: float = Field(1e-2, gt=0, lt=1, description="probability that a unit like the others is flagged")


@dataclass(frozen=True)
class FitRule:
    """Fit of diagonal weights and their covers; none of it bears on soundness, which the proof at the end decides."""

    points: int = 160  # frequencies at which orders are chosen and weights fitted first; the last fit has all
    covered: int = 300  # frequencies at which optimal covers are computed, between which they are interpolated
    units: int = 4  # largest residuals of a frequency in cover and fit; the check has all
    temperatures: tuple[float, ...] = (0.1, 0.03, 0.01, 0.003)  # nepers, of smoothed maxima; the last is 0.03 dB
    last_temperatures: tuple[float, ...] = (0.01, 0.003)  # of the fit at all frequencies, near the first one
    steps: int = 12  # at most, at each temperature, and of the search of a cover at each of its orders
    squarings: tuple[int, ...] = (1, 3, 6)  # s of the orders 2^s + 1 of the smoothed maximum of covers
    farthest: float = 1.5  # nepers: largest change of a parameter in a step of the joint fit
    damping: float = 1e-2  # of its first step at a temperature
    trials: int = 8  # of a step, each with eight times the damping
    pull: float = 1e-3  # towards the start, nepers: small, and it makes optima unique
    peak_price: float = 0.05  # of the peak of square weights, which decides among equal covers


@dataclass(frozen=True)
class MagnitudeRule:
    """Fit of one magnitude by quadratic programs, and its spectral factor."""

    floor: float = 1e-8  # of the largest magnitude: smaller ones count as that (-160 dB)
    exact_db: float = 1e-4  # excess that counts as none
    worth_db: float = 0.1  # by which a further pole and zero have to lower the excess
    highest: float = 10.0  # tau of the highest knot: 80 % of Nyquist
    rounds: int = 6  # of programs: frequencies at which n or d vanish between points join them
    edge: float = 1e-4  # share to which n and d may fall between the ends of the grid and DC or Nyquist
    below: float = 10.0  # weight of the distance to the data in a program: it keeps fits of one ratio near them
    settled: float = 1 - ITERATED  # ratio of steps of Dinkelbach's iteration that ends it
    room: float = 1e-5  # by which a step has to lower the ratio to be taken: what is nearer hangs on rounding
    damping: float = 3e-3  # least, of a pair of zeros or poles
    widest: float = 40.0  # y of a pair: two real ones 17 decades apart


@dataclass(frozen=True)
class ProofRule:
    """Check and proof of weights; a proof that fails here is refused, and the method says so."""

    margin: float = 1e-5  # of the peak: how far a level set is above it
    levels: int = 20  # at most; two or three are needed
    probe: float = 0.9  # of the peak: the level at which a pencil is tried
    near: float = 1e-3  # of its modulus: how far from the imaginary axis an eigenvalue of a crossing may be
    rows: int = 400  # of a pencil at most: eigenvalues of more take seconds for every unit
    density: int = 10  # points of the check for every one of the grid; modes join them
    decades: int = 4  # of tau beyond the grid that are checked
    a_decade: int = 15  # points in each
    rounding: float = ITERATED  # of ratios, by which weights are larger, and of frequencies that are one


@dataclass(frozen=True)
class OutlierRule:
    """Outlier scores: distances, the search for outliers, and when a score decides nothing."""

    frequencies: int = 120  # at most, that are looked at
    nominals: int = 64  # at most, from which distances are measured
    smoothing: float = 1 / 3  # decades of the moving average
    balancings: int = 50  # of Sinkhorn's scaling
    smallest: float = ROUNDING  # typical size of an entry, relative to row and column; difference of equal responses
    least: float = 1e-10  # distance of responses that are the same, relative to the typical one
    at_once: int = 4_000_000  # complex numbers of residuals in memory
    fewest: int = 8  # units: with fewer the verdict stays open; of studies of five a third of good units were beyond
    rounding_db: float = 1e-8  # levels are rounded to a tenth of that
    largest_db: float = 26.0  # beyond the largest of the others, twenty times as far away, at which a unit has to show
    largest_percent: float = 900.0  # change of gain, ten times as large, at which a unit has to show
    percent: float = 1.0  # change of an output's gain from which the smallest change that shows is extrapolated
    passed_percent: float = 100.0  # change of gain, twice as large, that a PASS excludes of every hidden state
    failed: float = 2.0  # error of the deployed observer over its bound beyond which a unit fails; above one it is open
    changed: int = 12  # units at most, whose gains are changed
    recorded: float = 0.5  # of the middle unit's samples: the variance of an estimate is at most twice the usual one


@dataclass(frozen=True)
class SetRule:
    """From systems or responses to a set: what a form leaves over, and what is shown."""

    condition: float = 1 / ROUNDING  # beyond it an inverse form does not rebuild a plant
    exact: float = ITERATED  # relative misfit that is rounding
    warned: float = 0.01  # misfit from which on another form is worth a thought
    resolved: float = 10 ** (3 / 20)  # fall of a bound beside a peak beyond which frequencies do not resolve it
    entry_order: int = 3  # of fits to single entries, which are shown and decide nothing
    entry_db: float = 1.0  # above an entry, at which a lower order of its fit is good enough
    singular: float = 1e10  # condition beyond which the paper's weights have no inverse
    retained: int = 500_000  # units times frequencies, at most, whose residuals are not computed for every proof again
    at_once: int = 10_000  # units times frequencies in a piece of a computation, which stays in a processor's cache


WEIGHT, FIT, MAGNITUDE, PROOF = WeightSettings(), FitRule(), MagnitudeRule(), ProofRule()
OUTLIER, SET = OutlierRule(), SetRule()
