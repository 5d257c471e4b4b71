"""The stages from recordings to observers: what is repeated where units are left out."""

from __future__ import annotations

from dataclasses import replace
from shutil import copyfile

from ..core.artifacts import save_artifact
from ..design.synthesize import synthesize_all
from ..identify.calibration import calibrate
from ..identify.identified import IdentifiedModels
from ..identify.identify import with_models
from ..uncertainty.quantify import quantify
from .config import Stage
from .engine.context import Context
from .engine.steps import StageStep
from .stages import read
from .stages.diagnose import diagnose


def run_calibrate(context: Context) -> None:
    """Calibrate the phase of every unit, where the lifting has one."""
    if context.phase_spec is not None:
        calibration = calibrate(context.population, context.facts, context.phase_spec, context.work)
        calibration.save(context.store.draft("calibration"))


def run_identify(context: Context) -> None:
    """Identify models of every kind in every condition."""
    base = IdentifiedModels(context.population, context.facts, context.lifting, context.calibration)
    with_models(base, context.config.identify, context.work).save_models(context.store.draft())


def run_quantify(context: Context) -> None:
    """Quantify how units differ, and what the report says beside it."""
    uncertain = quantify(context.identified, work=context.work, **dict(context.config.uncertainty))
    uncertain.save_sets(context.store.draft())
    diagnose(context, uncertain)


def run_synthesize(context: Context) -> None:
    """Design observers by every method that the study names, with their certificates, and choose the deployed one."""
    config, draft = context.config, context.store.draft
    tables = config.synthesis, config.observer, config.estimator, config.sensor
    designs = synthesize_all(context.uncertain, *tables, work=context.work)
    for name, design in designs.designs.items():
        observer = replace(design.observer, about={**design.observer.about, "study": config.name})
        observer.save(draft("observers", f"{name}.json"))
        design.synthesis.save(draft("synthesis", name))
        if design.certificate is not None:
            design.certificate.save(draft("observers", "relift", name))
    copyfile(draft("observers", f"{designs.deployed}.json"), draft("observers", "deployed.json"))
    content = {"names": list(designs.designs), "deployed": designs.deployed, "facts": designs.facts}
    save_artifact(draft("observers"), "observers", content)


LEARNING = (
    StageStep(Stage.READ, read.run, ("data", "split", "evaluate.reserve")),
    StageStep(Stage.CALIBRATE, run_calibrate, ("calibrate", "lifting")),
    StageStep(Stage.IDENTIFY, run_identify, ("identify", "lifting")),
    StageStep(Stage.QUANTIFY, run_quantify, ("uncertainty",)),
    StageStep(Stage.SYNTHESIZE, run_synthesize, ("synthesis", "estimator", "sensor", "observer")),
)
