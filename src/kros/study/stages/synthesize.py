"""Stage: observers by every method that the study asks for, with their certificates, and which of them is deployed."""

from __future__ import annotations

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
        config.predictor,
        config.sensor,
        robust=config.require.robust,
        work=context.work,
    )
    for name, design in found.designs.items():
        design.observer.save(draft("observers", f"{name}.json"))
        design.synthesis.save(draft("synthesis", name))
    found.designs[found.deployed].observer.save(draft("observers", "deployed.json"))
    save_running(draft("observers"), found.running)
    save_artifact(draft("observers"), "observers", {"names": list(found.designs), "deployed": found.deployed, "facts": found.facts})
