"""Names, keys and values that kros no longer has: each is refused with the changelog's sentence on its replacement."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

# A sentence, then indented the public names ``kros.package.name``, the keys of a study ``section.key``, and their
# values ``section.key=value`` that it is for.
_TABLE = """\
Subspace-identified predictors and steps of the estimator's design are no longer part of kros; use the method estimator.
    memory predictor synthesis.methods=memory kros.observer.identify_predictor kros.observer.PastMoments
    kros.observer.conditioned kros.observer.driven_coordinates kros.observer.with_internal kros.observer.residual_models
    kros.observer.tune_observer kros.observer.in_sizes kros.observer.EstimateKind kros.observer.Dropped
    kros.observer.DropoutBound kros.observer.dropout_bound
Noise is declared with the sensor, for example [sensor.position] noise = 1e-6; move it there.
    synthesis.noise
Keys for details of a method are no longer part of a study; remove the key, or call the function of the stage in Python.
    uncertainty.structure uncertainty.nominal uncertainty.max_order uncertainty.tolerance_db lifting.parameters
    uncertainty.false_alarm_rate calibrate.settle_s identify.margin identify.largest_residual identify.alpha_factor
    synthesis.set synthesis.injection synthesis.max_states synthesis.tune synthesis.input_weight synthesis.penalty
    synthesis.time_limit_s evaluate.monte_carlo evaluate.robustness=all observer.false_alarm_rate load.angle_rad
    load.memories load.condition load.angle load.current load.limit load.level_s
Limits, requirements and dropped units are no longer part of a study; remove the key, see metrics.json and data.exclude.
    limits require require.robust require.no_outliers uncertainty.drop_outliers
The deployed observer is no longer named in a study; remove the key deployed, and use kros export c --observer.
    observer.deployed
Robust controllers beyond H2 are no longer part of kros; use worst_case_h2, or hand the uncertain model to dkpy.
    kros.synthesis.Block kros.synthesis.MuBounds kros.synthesis.dk_iteration kros.synthesis.mu_bounds
    kros.synthesis.mu_lower kros.synthesis.mu_upper kros.synthesis.worst_case_hinf kros.synthesis.robust_gain
    kros.synthesis.RobustGain kros.synthesis.polish kros.synthesis.UnitCheck kros.synthesis.check_units
    synthesis.methods=worst_case_hinf
White-noise Kalman observers and placed poles are no longer part of kros; use kalman_tuned.
    observer.baselines=kalman_white observer.baselines=luenberger kros.synthesis.luenberger
Parts of the uncertainty are no longer public; use quantify, which takes models, systems and responses.
    kros.uncertainty.quantify_systems kros.uncertainty.quantify_responses kros.uncertainty.magnitude_tightness
    kros.uncertainty.completion kros.uncertainty.existence kros.uncertainty.choose_nominals
    kros.uncertainty.ResidualSystems kros.uncertainty.fit_weight kros.uncertainty.optimal_cover
    kros.uncertainty.FitSettings
Parts of the identification are no longer public; use kros.identify, whose result has models and calibration.
    kros.identify.bootstrap_refined kros.identify.find_segments kros.identify.resolve_branches kros.identify.unit_phase
    kros.identify.lifted_factor kros.identify.reduce_episode kros.identify.refine.RefinedModels
Fitted pykoop pipelines are no longer part of kros; identify their functions with kros.identify.
    kros.interop.AdoptedModel kros.interop.from_pykoop kros.interop.models_from_pykoop kros.interop.one_step_pairs
Readers of one format, and steps that follow events, are no longer part of kros; use kros.read and a class from Step.
    kros.data.read_csv_folder kros.data.read_motor_drive_raw kros.data.Split kros.data.check_population
    kros.data.TrueChannel kros.data.steps.ByDirection kros.data.steps.Cut kros.data.steps.Tare
Families that join texts, and centres and kernels to choose from, are no longer part of kros; write the formulas.
    kros.lifting.grid_centres kros.lifting.latin_hypercube_centres kros.lifting.random_centres kros.lifting.formulas
    kros.lifting.products kros.lifting.Kernel kros.lifting.concatenate
Random members of the uncertain set are no longer drawn; use the certificate, which bounds all of them.
    kros.evaluate.MonteCarlo kros.evaluate.sample_errors
Disturbed episodes and errors against truth are no longer public objects; use kros.run, whose metrics have them.
    kros.evaluate.Disturbance kros.evaluate.DisturbedEpisodes kros.evaluate.TrueErrors kros.evaluate.robustness_rows
    kros.evaluate.standard_disturbances
The function run_study is no longer part of kros; use kros.run, which takes a study too.
    kros.study.run_study
Calibrations of a load are no longer objects apart; use load_observer, or TorqueScale.calibrated, whose result has load.
    kros.motor_drive.LoadCalibration kros.motor_drive.calibrate_load kros.motor_drive.calibrate_torque
    kros.motor_drive.load_from_current
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
