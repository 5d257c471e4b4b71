"""Stage: observers by every method that the study asks for, with their certificates, and which of them is deployed."""

from __future__ import annotations

from dataclasses import replace
from shutil import copyfile

from ...core.artifacts import save_artifact
from ...design.certificates import save_running
from ...design.synthesize import synthesize_all
from ..engine.context import Context


def run(context: Context) -> None:
    """Design and save."""
    config, draft = context.config, context.store.draft
    found = synthesize_all(
        context.uncertain,
        config.synthesis,
        config.observer,
        config.estimator,
        config.sensor,
        config.limits,
        robust=config.require.robust,
        work=context.work,
    )
    for name, design in found.designs.items():
        replace(design.observer, about={**design.observer.about, "study": config.name}).save(
            draft("observers", f"{name}.json")
        )
        design.synthesis.save(draft("synthesis", name))
    copyfile(draft("observers", f"{found.deployed}.json"), draft("observers", "deployed.json"))
    save_running(draft("observers"), found.running)
    save_artifact(
        draft("observers"),
        "observers",
        {"names": list(found.designs), "deployed": found.deployed, "facts": found.facts},
    )
