"""Settings of quantification: form, nominal, order and outliers; and how weights are fitted and checked."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from pydantic import Field

from ..core.settings import Settings

FORMS = Literal[
    "additive",
    "input_multiplicative",
    "output_multiplicative",
    "inverse_additive",
    "inverse_input_multiplicative",
    "inverse_output_multiplicative",
]


class UncertaintySettings(Settings):
    """Uncertainty model and outlier scores: the keys of a study."""

    form: FORMS = Field("inverse_input_multiplicative", description="of the uncertain set")
    n_freqs: int = Field(1000, ge=50, description="points of the frequency grid")
    outlier_form: FORMS = Field("additive", description="of the residuals that outlier scores are made of")


class QuantifySettings(UncertaintySettings):
    """What `kros.quantify` takes beside models; a study has the defaults of what is no key of it."""

    nominal: str | None = Field(
        None,
        description="a unit; by default the best one, and observers that are free to may have the mean of the units",
    )
    max_order: int = Field(4, ge=1, le=8, description="largest order of an entry of a weight")
    tolerance_db: float = Field(1.0, gt=0, description="how far a weight may be above the bound of the residuals")
    false_alarm_rate: float = Field(1e-2, gt=0, lt=1, description="probability that a unit like the others is flagged")


class FitSettings(Settings):
    """How diagonal weights are fitted; none of it bears on soundness, which the proof at the end decides."""

    points: int = Field(160, ge=8, description="frequencies of the joint fit: what is missed between them joins it")
    units: int = Field(4, ge=1, description="largest residuals of a frequency in the joint fit; the check sees all")
    temperatures: tuple[float, ...] = Field(
        (0.1, 0.03, 0.01, 0.003), min_length=1, description="nepers, of the smoothed maxima; the last is 0.03 dB"
    )
    steps: int = Field(10, ge=1, description="largest number of steps at one temperature")
    pull: float = Field(1e-3, gt=0, description="towards the start, nepers: small, and it makes the optimum unique")
    peak_price: float = Field(0.05, ge=0, description="of the peak of square weights, which decides among equal covers")
    gain: float = Field(0.1, gt=0, lt=1, description="of the tolerance: what a higher order of an entry has to bring")
    enough: float = Field(0.9, gt=0, le=1, description="of the tolerance, within which an order is good enough")
    density: int = Field(10, ge=1, description="points of the check for every one of the grid; modes join them")
    rounds: int = Field(5, ge=1, description="fits, each with the frequencies and units missed by the one before")
    missed_db: float = Field(0.05, gt=0, description="cost between the points of the fit that brings further ones")
    farthest: float = Field(1.5, gt=0, description="nepers: largest change of a parameter in a step")
    damping: float = Field(1e-2, gt=0, description="of the first step at a temperature")
    trials: int = Field(8, ge=1, description="of a step, each with eight times the damping")
    deficit: float = Field(1.02, gt=1, description="ratio up to which a weight is lifted; beyond it is fitted again")
    block: int = Field(200, ge=2, description="units at once: of more, those that decide are fitted, all are checked")


@dataclass(frozen=True)
class CoverRule:
    """Search of the optimal cover; its scale is computed from all units at last, so that it is sound in any case."""

    squarings: tuple[int, ...] = (1, 3, 6)  # s of the orders 2^s + 1 of the smoothed maximum, one after the other
    newton: int = 8  # steps at each
    settled: float = 1e-9  # nepers: a smaller step ends them
    frequencies: int = 60  # fewest in the search, between which magnitudes are interpolated
    entries: int = 1200  # of residuals times frequencies in the search: 300 frequencies for 2 x 2
    units: int = 6  # largest residuals of a frequency
    pull: float = 1e-3  # towards equal entries, which makes the optimum unique
    reach: float = 2.0  # nepers, of a step
    difference: float = 1e-5  # nepers, of the differences of gradients


@dataclass(frozen=True)
class MagnitudeRule:
    """Fit of one magnitude by linear programs, and its spectral factor."""

    floor: float = 1e-8  # of the largest magnitude: smaller ones count as that (-160 dB)
    exact: float = 10**1e-5  # ratio of squared magnitudes, 1e-4 dB, that counts as one
    highest: float = 10.0  # tau of the highest knot: 80 % of Nyquist
    even: float = 0.5  # share of the knots that is spaced evenly
    rounds: int = 6  # of programs: frequencies at which n or d vanish between points join them
    edge: float = 1e-4  # share to which n and d may fall between the ends of the grid and DC or Nyquist
    steps: int = 60  # of Dinkelbach's iteration; about twenty are needed
    settled: float = 1 - 1e-10  # ratio of steps that ends it
    largest: float = 1e8  # of an unknown of a program; solutions are at most some thousands
    exceeded: float = 1e-10  # rounding of rows of size one
    across: float = 1e-11  # rounding of their changes
    real: float = 1e-12  # relative imaginary part up to which a root is real
    real_section: float = 1e-9  # the same of sections
    far: float = 1e30  # tau at Nyquist
    damping: float = 3e-3  # least, of a pair of zeros or poles
    widest: float = 40.0  # y of a pair: two real ones 17 decades apart
    inside: float = 1e-13  # least distance of poles and zeros from the unit circle
    digits: int = 30  # of the arithmetic of roots, which spread over twice as many decades as frequencies


@dataclass(frozen=True)
class ProofRule:
    """Check and proof of weights; a proof that fails here is refused, and the method says so."""

    margin: float = 1e-5  # of the peak: how far a level set is above it
    levels: int = 20  # at most; two or three are needed
    probe: float = 0.9  # of the peak: the level at which a pencil is tried
    near: float = 1e-3  # of its modulus: how far from the imaginary axis an eigenvalue of a crossing may be
    finer: int = 20  # points between the neighbours of a maximum
    zooms: int = 3  # rounds of them
    rows: int = 400  # of a pencil at most: eigenvalues of more take seconds for every unit
    light: float = 0.1  # damping up to which a mode is a peak or a notch
    around: tuple[float, ...] = (-3.0, -1.0, 0.0, 1.0, 3.0)  # half-widths, where a mode is looked at
    apart: float = 0.5  # half-widths, nearer than which modes are one
    modes: int = 400  # at most, the least damped ones first
    decades: int = 4  # of tau beyond the grid that are checked
    a_decade: int = 15  # points in each
    even: int = 101  # points evenly over frequency
    worst: int = 20  # frequencies that join a fit in a round
    same: float = 1e-9  # relative distance of frequencies that are one
    rounding: float = 1e-9  # of ratios, by which weights are larger


@dataclass(frozen=True)
class BandRule:
    """Energies in bands and their cover, which holds in any case: only its size depends on these numbers."""

    bands: int = 96
    rounding: float = 1e-13  # of a channel's energy: correlations by FFT and their sums with weights below 2 / lag
    at_once: int = 2_000_000  # lags of signals in memory
    block: int = 2048  # lags whose weights are in memory
    iterations: int = 60  # at most
    turns: int = 10  # after which bands that are done are left
    enough: float = 1.002  # ratio to the least multiple that covers, which ends the iteration
    regular: float = 1e-14  # of the largest eigenvalue: smaller ones are rounding
    ridge: float = 1e-6  # of the largest energy, in every direction: the iteration needs its square above rounding


@dataclass(frozen=True)
class OutlierRule:
    """Outlier scores: distances, the search for outliers, and when a score decides nothing."""

    frequencies: int = 120  # at most, that are looked at
    nominals: int = 64  # at most, from which distances are measured
    smoothing: float = 1 / 3  # decades of the moving average
    balancings: int = 50  # of Sinkhorn's scaling
    smallest: float = 1e-12  # typical size of an entry, relative to its row and column
    equal: float = 1e-12  # relative difference of responses that are the same
    least: float = 1e-10  # distance of responses that are the same, relative to the typical one
    at_once: int = 4_000_000  # complex numbers of residuals in memory
    fewest: int = 8  # units: with fewer the verdict stays open; of studies of five a third of good units were beyond
    rounding_db: float = 1e-8  # levels are rounded to a tenth of that
    largest_db: float = 26.0  # beyond the largest of the others, twenty times as far away, at which a unit has to show
    largest_percent: float = 900.0  # change of gain, ten times as large, at which a unit has to show
    percent: float = 1.0  # change of an entry from which the smallest change that shows is extrapolated
    changed: int = 12  # units at most, whose entries are changed
    same: float = 1e-9  # relative difference of the Gram matrices of one recording, read twice
    recorded: float = 0.5  # of the middle unit's samples: the variance of an estimate is at most twice the usual one


@dataclass(frozen=True)
class SetRule:
    """From systems or responses to a set: what a form leaves over, grids of continuous systems, and what is shown."""

    condition: float = 1e12  # beyond it an inverse form does not rebuild a plant
    exact: float = 1e-9  # relative misfit that is rounding
    warned: float = 0.01  # misfit from which on another form is worth a thought
    resolved: float = 10 ** (3 / 20)  # fall of a bound beside a peak beyond which frequencies do not resolve it
    negligible: float = 1e-8  # of the largest bound: smaller peaks do not count
    beyond: float = 10.0  # how far above its last frequency the grid of continuous systems goes on
    points_beyond: int = 15
    points: int = 1000  # of the default grid of continuous systems
    units: int = 200  # that are stored for a picture
    entry_order: int = 3  # of fits to single entries, which are shown and decide nothing
    singular: float = 1e10  # condition beyond which the paper's weights have no inverse
    nominals: int = 64  # at most, of the mean over pairs of units
    at_once: int = 10_000  # units times frequencies in a piece of a computation, which stays in a processor's cache


COVER, MAGNITUDE, PROOF, BANDS, OUTLIER, SET = (
    *(CoverRule(), MagnitudeRule(), ProofRule()),
    *(BandRule(), OutlierRule(), SetRule()),
)
