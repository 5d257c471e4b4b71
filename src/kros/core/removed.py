"""Names, keys and values that kros no longer has: each is refused with the changelog's sentence on its replacement."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from typing import Any

# A sentence, then indented what it is for: public names ``kros.package.name``, keys ``section.key`` of a study, values
# ``section.key=value``; behind ``kros.package:`` or ``section:`` stand names of that package or section alone.
_TABLE = """\
Subspace-identified predictors are no longer part of kros; use the method estimator.
    memory predictor synthesis: methods=memory kros.observer: identify_predictor PastMoments
Noise is declared with the sensor, for example [sensor.position] noise = 1e-6; move it there.
    synthesis: noise
Keys for details of a method are no longer part of a study; remove the key, or call the function of the stage in Python.
    uncertainty: structure nominal max_order tolerance_db false_alarm_rate lifting: parameters calibrate: settle_s
    identify: margin largest_residual alpha_factor synthesis: set injection max_states tune input_weight penalty
    time_limit_s evaluate: monte_carlo observer: false_alarm_rate load: angle_rad memories condition angle current limit
    level_s
Limits, requirements and dropped units are no longer part of a study; remove the key, see metrics.json and data.exclude.
    limits require require: robust no_outliers uncertainty: drop_outliers
The deployed observer is no longer named in a study; remove the key deployed, and use kros export c --observer.
    observer: deployed
Robust controllers beyond H2 are no longer part of kros; use worst_case_h2, or hand the uncertain model to dkpy.
    kros.synthesis: Block MuBounds dk_iteration mu_bounds mu_lower mu_upper worst_case_hinf robust_gain RobustGain
    polish UnitCheck check_units synthesis: methods=worst_case_hinf
White-noise Kalman observers and placed poles are no longer part of kros; use kalman_tuned.
    observer: baselines=kalman_white baselines=luenberger kros.synthesis: luenberger
Parts of the uncertainty are no longer public; use quantify, which takes models, systems and responses.
    kros.uncertainty: quantify_systems quantify_responses magnitude_tightness choose_nominals fit_weight optimal_cover
    bounds Cover FittedMagnitude NominalChoice OutlierScore Weight
Fitted pykoop pipelines are no longer part of kros; identify their functions with kros.identify.
    kros.interop: AdoptedModel models_from_pykoop one_step_pairs
Readers of one format, and steps that follow events, are no longer part of kros; use kros.read and a class from Step.
    kros.data: read_csv_folder read_motor_drive_raw check_population TrueChannel kros.data.steps: ByDirection Cut Tare
Families that join texts, and centres and kernels to choose from, are no longer part of kros; write the formulas.
    kros.lifting: grid_centres latin_hypercube_centres random_centres formulas products Kernel concatenate
Random members of the uncertain set are no longer drawn; use the certificate, which bounds all of them.
    kros.evaluate: MonteCarlo sample_errors
Disturbed episodes and errors against truth are no longer public objects; use kros.run, whose metrics have them.
    kros.evaluate: Disturbance DisturbedEpisodes TrueErrors robustness_rows standard_disturbances
The function run_study and ExportError are no longer part of kros; use kros.run, and KrosError.
    kros.study: run_study kros.core: ExportError
Controllers are no longer polished or reduced in order; use balred of python-control, and close the plant's loop with
the result for its norms.
    kros.synthesis: reduce_controller
Refined models have no class apart from others; refine_population returns their matrices.
    kros.identify.refine: Refinement
Models of python-control are no longer quantified by functions of their own; use kros.quantify, which takes systems and
response data, with from_control for transfer functions, and to_control for the nominal and the weights of the result.
    kros.interop: quantify_models UncertaintyForControl uncertainty_to_control
Variation and noise are no longer an object; use the noise_share of a run, under uncertainty in metrics.json.
    kros.uncertainty: VariationAndNoise variation_and_noise
The numerical error of generated code is no longer an object; kros export c prints it.
    kros.export: HeldOut
Runs of a batch that follow a parameter are no longer public; use track of a running observer, or kros estimate --track.
    kros.observer: track_parameter Tracked
Baselines are no longer public classes; name them in observer.baselines of a study, ekf and filtered_difference.
    kros.observer: ExtendedKalman FilteredDifference
Bounds for recorded signals are no longer a public function; kros.synthesize computes them, its facts hold
set_bound_percent.
    kros.observer: signal_bound SignalBound
How a load is read and scaled is no longer public; a study with recordings of the condition load estimates load torque.
    kros.motor_drive: LoadSettings TorqueScale known_load load_observer
Status bits of a batch, monitors, guards, filter banks and observers side by side are internal; step a running observer,
read its status, and let kros.synthesize make the others.
    kros.observer: run_with_status sample_status Monitor Guard FilterBank run_observers
The raw layout of motor drives is no longer written by a public function; use kros simulate --format raw.
    kros.data: write_raw
Tables of preparation steps are no longer parsed by a public function; use kros.read, which takes them as prepare.
    kros.data.steps: parse_steps
Report and figures of a run are no longer written by public functions; use kros report and kros figures.
    kros.report: render write_figures
Results are no longer drawn by a function; use their method plot, such as models.plot().
    kros.report: plot
Models of units are no longer converted by a function of their own; use to_control(models.systems([unit])[0]).
    kros.interop: models_to_control
The array format of pykoop is no longer read and written; use kros.from_arrays with an array for every episode.
    kros.data: from_pykoop to_pykoop kros.interop: from_pykoop to_pykoop
Random Fourier features are no longer a family of liftings; use radial, with centres by k-means.
    kros.lifting: fourier_features
Resampled models are no longer public; kros.quantify and the report use them by themselves.
    kros.identify: ModelSamples bootstrap_edmd episode_weights
Factors of single episodes are no longer public; use unit_factors, which takes the same arguments.
    kros.identify: episode_factors
The residual-shaped observer is no longer a public function; use kros.synthesize with the method residual_h2.
    kros.synthesis: ResidualProblem residual_h2
Undeclared disturbances are no longer simulated; remove the key, and see sensor_gains under deployment in metrics.json.
    evaluate: robustness
Parts of the evaluation are no longer public; a study computes them, error_percent and unit_interval remain.
    kros.evaluate: Kind error_rms error_spectrum next_unit_bound true_errors
"""


def _places(text: str) -> str:
    """Return all places in full."""
    prefix, places = "", list[str]()
    for word in text.split():
        prefix = f"{word[:-1]}." if word.endswith(":") else prefix
        places += [] if word.endswith(":") else [prefix + word]
    return " ".join(places)


REMOVED = tuple(
    (" ".join(sentence.split()), _places(text))
    for sentence, text in re.findall(r"((?:^\S.*\n)+)((?:^ .*\n)+)", _TABLE, re.MULTILINE)
)


def instead_of(place: str) -> str:
    """Return the sentence for a name, or a key or value whose section may be missing; empty where it never was."""
    matches = (sentence for sentence, places in REMOVED if any(f".{p}".endswith(f".{place}") for p in places.split()))
    return next(matches, "")


def refusing(package: str) -> Callable[[str], Any]:
    """Return a ``__getattr__`` (PEP 562) for a package, which says what replaces a name that was removed."""

    def find(name: str) -> Any:
        reason = instead_of(f"{package}.{name}")
        raise AttributeError(f"module {package!r} has no attribute {name!r}" + (f": {reason}" if reason else ""))

    return find


def lazy_names(
    package: str, home: Mapping[str, str], public: Sequence[str]
) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Return the ``__getattr__`` and ``__dir__`` of a package whose names are imported on first use (PEP 562)."""
    unknown = refusing(package)

    def find(name: str) -> Any:
        return getattr(import_module(f".{home[name]}", package), name) if name in home else unknown(name)

    return find, lambda: sorted({*vars(sys.modules[package]), *public})
