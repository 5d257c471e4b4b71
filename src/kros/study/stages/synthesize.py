"""Stage: observers by every method that the study asks for, with their certificates, and which of them is deployed."""

from __future__ import annotations

from dataclasses import replace
from shutil import copyfile

from ...core.artifacts import save_artifact
from ...design.synthesize import synthesize_all
from ..engine.context import Context


def run(context: Context) -> None:
    """Design and save."""
    config, draft = context.config, context.store.draft
    tables = config.synthesis, config.observer, config.estimator, config.sensor
    found = synthesize_all(context.uncertain, *tables, work=context.work)
    for name, design in found.designs.items():
        observer = replace(design.observer, about={**design.observer.about, "study": config.name})
        observer.save(draft("observers", f"{name}.json"))
        design.synthesis.save(draft("synthesis", name))
        if design.certificate is not None:
            design.certificate.save(draft("observers", "relift", name))
    copyfile(draft("observers", f"{found.deployed}.json"), draft("observers", "deployed.json"))
    content = {"names": list(found.designs), "deployed": found.deployed, "facts": found.facts}
    save_artifact(draft("observers"), "observers", content)
