"""Names, keys and values that kros no longer has: each is refused with the changelog's sentence on its replacement."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

# A sentence, then indented the public names ``kros.package.name``, the keys of a study ``section.key``, and their
# values ``section.key=value`` that it is for.
_TABLE = """\
Subspace-identified predictors are no longer part of kros; use the method estimator, whose settings are in [estimator].
    memory predictor synthesis.methods=memory kros.observer.identify_predictor kros.observer.PastMoments
Noise is declared with the sensor, for example [sensor.position] noise = 1e-6; move it there.
    synthesis.noise
Structures of weights to choose from are no longer part of kros; remove the key structure, weights are diagonal.
    uncertainty.structure
Systems and responses are no longer quantified by functions of their own; use quantify, which takes systems, responses
(form before freqs_hz) and models of kros.identify.
    kros.uncertainty.quantify_systems kros.uncertainty.quantify_responses
Order against tightness of weights is no longer part of kros; use fit_magnitude, whose result has overbound_db.
    kros.uncertainty.magnitude_tightness
Where a form is exact is no longer a function of its own; use misfit, which is zero there.
    kros.uncertainty.completion kros.uncertainty.existence
The nominals of all forms are no longer one function; use choose_nominal for each form.
    kros.uncertainty.choose_nominals
Parameters of a lifting are not named; a formula that reads phase has one for every unit, remove the key parameters.
    lifting.parameters
What is left out at the start of a segment of constant speed is no longer a setting; remove the key settle_s, it is a
two-hundredth of an episode.
    calibrate.settle_s
Steps of the design of predictors and residual-shaped observers are no longer public; use synthesize with method
estimator or residual_h2.
    kros.observer.conditioned kros.observer.driven_coordinates kros.observer.with_internal kros.observer.residual_models
    kros.observer.tune_observer kros.observer.in_sizes
Filtered estimates are those of a running observer, whose gain follows from the correction; use running.filter.
    kros.observer.EstimateKind
Refined models of resampled episodes are no longer part of kros; use bootstrap_edmd, or the noise_share of a run.
    kros.identify.bootstrap_refined
Disturbed measurements of every observer, unit and condition are no longer part of a study; use evaluate.robustness =
true.
    evaluate.robustness=all
The observers kalman_white and luenberger are no longer part of kros; use kalman_tuned.
    observer.baselines=kalman_white observer.baselines=luenberger
The set of worst-case synthesis, of signals or of the form, is chosen on held-out episodes; remove the key set.
    synthesis.set
Fitted pykoop pipelines are no longer part of kros; identify their functions with kros.identify, recordings go both ways
with kros.data.
    kros.interop.AdoptedModel kros.interop.from_pykoop kros.interop.models_from_pykoop
Pairs of rows are no longer part of kros; use y of KoopmanRegressor.fit, or GroupKFold.
    kros.interop.one_step_pairs
Preparation steps that follow events are no longer part of kros; use offset and trim, or a class of your own that
derives from Step.
    kros.data.steps.ByDirection kros.data.steps.Cut kros.data.steps.Tare
Centres other than those of k-means are no longer part of kros; use kmeans_centres, or a list of points.
    kros.lifting.grid_centres kros.lifting.latin_hypercube_centres kros.lifting.random_centres
Families that only join texts are no longer part of kros; write the formulas under functions or input_functions.
    kros.lifting.formulas kros.lifting.products
Kernels of random Fourier features are no longer a choice; fourier_features approximates the Gaussian kernel.
    kros.lifting.Kernel
Bounds of the structured singular value and D-K iteration are no longer part of kros; hand the uncertain model to dkpy,
as examples/output_feedback does.
    kros.synthesis.Block kros.synthesis.MuBounds kros.synthesis.dk_iteration kros.synthesis.mu_bounds
    kros.synthesis.mu_lower kros.synthesis.mu_upper
Worst-case H-infinity observers and gains are no longer part of kros; use worst_case_h2, which bounds the error of every
member too.
    kros.synthesis.worst_case_hinf kros.synthesis.robust_gain kros.synthesis.RobustGain
    synthesis.methods=worst_case_hinf
Controllers are no longer polished or reduced in order; use balred of python-control, and close the plant's loop with
the result for its norms.
    kros.synthesis.polish kros.synthesis.reduce_controller synthesis.max_states synthesis.tune
Placed poles are no longer part of kros; use kalman.
    kros.synthesis.luenberger
Random members of the uncertain set are no longer drawn in a study; the certificate bounds all of them, and the report
shows disturbed measurements.
    kros.evaluate.MonteCarlo kros.evaluate.sample_errors evaluate.monte_carlo
Readers of one format are no longer public; use kros.read, which finds the format or is told it.
    kros.data.read_csv_folder kros.data.read_motor_drive_raw kros.data.read_parquet
The check of a population and the class of a split are no longer public; kros.identify checks, split_episodes splits.
    kros.data.Split kros.data.check_population
The function run_study is no longer part of kros; use kros.run, which takes a study too.
    kros.study.run_study
The load's angle and the size of its observer are no longer settings; remove the keys, and let the step offset make the
angle zero where the moment is.
    load.angle_rad load.memories
The place of corrections is no longer chosen in a study: worst_case_h2 corrects the state, mixed the input; remove the
key injection.
    synthesis.injection
Parts of the phase calibration are no longer public; kros.identify calibrates, and its result has the calibration.
    kros.identify.find_segments kros.identify.resolve_branches kros.identify.unit_phase
Factors of single episodes before their parameters are known are no longer public; use kros.identify.episode_factors.
    kros.identify.lifted_factor kros.identify.reduce_episode
Refined models have no class apart from others; refine_population returns their matrices.
    kros.identify.refine.RefinedModels kros.identify.refine.Refinement
Families are joined as tuples, and a lifting refuses functions that repeat; write harmonics(...) + polynomials(...).
    kros.lifting.concatenate
TrueChannel is no longer part of kros; use Channel with the role truth, Channel(name, Role.TRUTH, unit, of=state).
    kros.data.TrueChannel
How weights and outlier scores are computed is no longer set in a study; use kros.quantify, which takes nominal,
max_order, tolerance_db and false_alarm_rate.
    uncertainty.nominal uncertainty.max_order uncertainty.tolerance_db uncertainty.false_alarm_rate
Flagged units are no longer dropped by a study itself; name them under data.exclude.
    uncertainty.drop_outliers
Classes of single results of quantification are no longer public; use what quantify, choose_nominal, fit_magnitude and
score_outliers return.
    kros.uncertainty.Cover kros.uncertainty.FittedMagnitude kros.uncertainty.NominalChoice kros.uncertainty.OutlierScore
    kros.uncertainty.Weight
Bounds of residuals over every nominal are no longer a function; use sigma_max of residual, or choose_nominal.
    kros.uncertainty.bounds
Models of python-control are no longer quantified by a function of their own; use kros.quantify, which takes systems and
response data, with from_control for transfer functions and uncertainty_to_control for the result.
    kros.interop.quantify_models
Variation and noise are no longer an object; use the noise_share of a run, under uncertainty in metrics.json.
    kros.uncertainty.VariationAndNoise kros.uncertainty.variation_and_noise
What the fit of a weight is made of is no longer public; use quantify.
    kros.uncertainty.ResidualSystems kros.uncertainty.fit_weight kros.uncertainty.optimal_cover
    kros.uncertainty.FitSettings
Margins of stability, the largest residual of identification and the factor of alpha are no longer settings; remove the
keys, or set identify.alpha to a number.
    identify.margin identify.largest_residual identify.alpha_factor
The spectrum of the inputs, the penalty on corrections and the time limit are no longer settings of a study; remove the
keys, and use kros.design.methods for a method with other options.
    synthesis.input_weight synthesis.penalty synthesis.time_limit_s
Limits of states are no longer declared; remove the table limits, kros detects limits that recordings reach.
    limits
The deployed observer is no longer named in a study; remove the key deployed, and use kros export c --observer.
    observer.deployed
The rate of false alarms of the monitor is no longer a setting of a study; remove the key, it is 0.02.
    observer.false_alarm_rate
Names of condition, angle and current, limit and time constant of a load are no longer settings; remove the keys, name
the condition load and the states position and current.
    load.condition load.angle load.current load.limit load.level_s
Requirements are no longer part of a study; remove the table require, and read certificates and outliers in
metrics.json.
    require require.robust require.no_outliers
Certificates for lost measurements are no longer part of kros; use the method estimator, whose estimates stay bounded
for any pattern of losses, and the report's figure of lost measurements.
    kros.observer.Dropped kros.observer.DropoutBound kros.observer.dropout_bound
Calibrations of a load are no longer objects apart; a study with recordings of the condition load makes them.
    kros.motor_drive.LoadCalibration kros.motor_drive.calibrate_load
The torque constant has no functions apart; a study with recordings of the condition load finds it.
    kros.motor_drive.calibrate_torque kros.motor_drive.load_from_current
The numerical error of generated code is no longer part of kros; use CompiledObserver, which runs it on recordings.
    kros.export.HeldOut
Runs of a batch that follow a parameter are no longer public; use track of a running observer, or kros estimate --track.
    kros.observer.track_parameter kros.observer.Tracked
Baselines are no longer public classes; name them in observer.baselines of a study, ekf and filtered_difference.
    kros.observer.ExtendedKalman kros.observer.FilteredDifference
Bounds for recorded signals are no longer a public function; kros.synthesize computes them, its facts hold
set_bound_percent.
    kros.observer.signal_bound kros.observer.SignalBound
How a load is read and scaled is no longer public; a study with recordings of the condition load estimates load torque.
    kros.motor_drive.LoadSettings kros.motor_drive.TorqueScale kros.motor_drive.known_load
    kros.motor_drive.load_observer
Status bits of a batch, monitors, guards and observers side by side are internal; step a running observer, read its
status, and let kros.synthesize make the others.
    kros.observer.run_with_status kros.observer.sample_status kros.observer.Monitor kros.observer.Guard
    kros.observer.run_observers
Errors of single units against the bound are no longer public; kros.synthesize checks them, the design has bound_holds.
    kros.synthesis.UnitCheck kros.synthesis.check_units
The raw layout of motor drives is no longer written by a public function; use kros simulate --format raw.
    kros.data.write_raw
Tables of preparation steps are no longer parsed by a public function; use kros.read, which takes them as prepare.
    kros.data.steps.parse_steps
Report and figures of a run are no longer written by public functions; use kros report and kros figures.
    kros.report.render kros.report.write_figures
Models of units are no longer converted by a function of their own; use to_control(models.systems([unit])[0]).
    kros.interop.models_to_control
"""
REMOVED = tuple(
    (" ".join(sentence.split()), " ".join(places.split()))
    for sentence, places in re.findall(r"((?:^\S.*\n)+)((?:^ .*\n)+)", _TABLE, re.MULTILINE)
)


def instead_of(place: str) -> str:
    """Return the sentence for a name, or a key or value whose section may be missing; empty where it never was."""
    matches = (
        sentence for sentence, places in REMOVED if any(p == place or p.endswith(f".{place}") for p in places.split())
    )
    return next(matches, "")


def refusing(package: str) -> Callable[[str], Any]:
    """Return a ``__getattr__`` (PEP 562) for a package, which says what replaces a name that was removed."""

    def find(name: str) -> Any:
        reason = instead_of(f"{package}.{name}")
        raise AttributeError(f"module {package!r} has no attribute {name!r}" + (f": {reason}" if reason else ""))

    return find
