"""For who distrusts: what is claimed, under which assumptions, how it was recomputed, and one table of what stands behind every observer."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ...core.artifacts import load_artifact
from ..content import Cell, Cells, Section, Table, where
from ..names import observer_label
from ..run_folder import NotShownError, RunFolder
from ..trust import dropout_text, sensor_text, trusts
from ..verdict import verdict

_COLUMNS = (
    "For the set: “plants”, a bound on the error's H2 norm for every plant between the weights around the nominal unit; “signals”, a bound on its RMS for all "
    "signals with the power in every band of frequency that was recorded. As it runs: a bound with the state re-lifted at every step, from the model's "
    "one-step residual to the error, for any machine. Dropouts and sensor: the severity at which the error doubles on held-out episodes, geometric mean over "
    "the states that are not measured; “less than” is the mildest that was tried. Noise, resolution and bias are in percent of the largest value, delays in "
    "samples; gaps take a tenth of the time, whatever their length."
)
_ASSUMED = (
    "The units recorded stand for those to come: nothing here is about another batch, or about wear.",
    "Motion did not depend on any estimate while it was recorded. With a loop closed on the estimate it does, and neither set holds it.",
    "The set of plants: every machine is the nominal model perturbed by at most the weights, in one form. The set of signals: residuals have at most the "
    "recorded power in every band.",
    "Errors are those of the recordings' own sensors, or of the sensor that is declared; what a state really was is known where the recordings say so.",
)
_RECOMPUTED = (
    "Errors are counted on held-out episodes that took no part in models, weights, tuning or choices.",
    "Norms are recomputed after every solver: H2 by Lyapunov equations, H∞ by the bounded-real bisection. What fails its check is not returned.",
    "Weights are checked on the responses as they are used, for every unit and frequency.",
    "Every artifact carries a checksum; the same recordings and study give the same bytes. metrics.json has every number of this page.",
)


def section(run: RunFolder, metrics: Mapping[str, Any]) -> Section | None:
    """Return claims, assumptions, recomputations and the table; None where no observer was made."""
    deployed = metrics["study"].get("deployed")
    found = dict(sorted(trusts(metrics).items(), key=lambda item: item[0] != deployed))
    if not found:
        return None
    rows: list[Cells] = [
        [
            observer_label(name),
            *(
                Cell(text, strong=text.startswith("no") and name == deployed)
                for text in (trust.by_set, trust.as_it_runs)
            ),
            *(dropout_text(metrics, name, trust, run.measured_states), sensor_text(metrics, name, run.measured_states)),
        ]
        for name, trust in found.items()
    ]
    head = ["observer", "certified for the set", "certified as it runs", "tolerates dropouts", "sensor needed"]
    table = Table(
        head, rows, "What stands behind every observer", emphasised=where(found, deployed), prose=True, sortable=True
    )
    claimed = verdict(metrics, run.measured_states)
    lists = [
        ("What is claimed", claimed),
        ("Under which assumptions", [*_ASSUMED, *_assumed(run, deployed)]),
        ("How it was recomputed", list(_RECOMPUTED)),
    ]
    return Section("trust", "Trust", [], [table, *_remarks(run)], lists=lists, notes=[_COLUMNS])


def _assumed(run: RunFolder, deployed: str | None) -> list[str]:
    """Assumptions of the certificate of the deployed observer as it runs."""
    if deployed is None or not run.has("observers/relift.json"):
        return []
    own = load_artifact(run.folder / "observers", "relift")[0]["certificates"].get(deployed, {}).get("assumptions", [])
    return [f"As “{observer_label(deployed)}” runs: {'; '.join(own)}."] if own else []


def _remarks(run: RunFolder) -> list[Table]:
    """Reasons why there is no observer, or no certificate for the set of plants; observers with the same reason share a row."""
    try:
        facts = run.observers_record["facts"]
    except NotShownError:
        return []
    reasons: dict[tuple[str, str], list[str]] = {}
    for name, own in facts.items():
        if own.get("reason"):
            what = "not made" if own.get("status") == "failed" else "not certified for plants"
            reason = "; ".join(dict.fromkeys(own["reason"].split("; ")))
            reasons.setdefault((what, reason), []).append(observer_label(name))
    rows: list[Cells] = [
        ["; ".join(names), Cell(what, strong=True), reason] for (what, reason), names in reasons.items()
    ]
    caption = "What could not be made, or not be certified for the set of plants, and why"
    return [Table(["observer", "", "reason"], rows, caption, prose=True, folded=True)] if rows else []
