"""What is certified about every observer, under which assumptions, and how it was recomputed."""

from collections.abc import Mapping

from ...core import ByName
from ...core.linalg import radius_text
from ...design.task import split_name
from ..content import Column, Row, Section, Table, build
from ..facts import Facts
from ..names import label_of, minus, observer_label

_TEXT = (
    "For the set of plants: a bound on the H2 norm of the error for every plant between the weights, and a lower bound "
    "for corrections of this kind. For recorded signals: a bound on the RMS error for weighted combinations of the "
    "recorded residuals, beside the worst RMS error on held-out episodes. These are other signals and may exceed it. "
    "At run time: a bound on the gain from the model's one-step residual to the error, with the state re-lifted at "
    "every step. The estimator has no model; its entry is the largest error on a unit left out of its regression."
)
_ASSUMED = (
    "The recorded units represent those to come: another batch and wear are not covered.",
    "The recorded signals depended on no estimate: the certificates do not hold if a controller uses the estimate.",
    "The set of plants: every unit is the nominal model perturbed by at most the weights, in one form. It "
    "bounds how units differ, not how models differ from units.",
    "The recorded signals: the residual combines recorded ones, with weights whose sizes sum to at most one.",
    "Errors are those relative to the recorded sensors, unless the true signal is known.",
)
_RECOMPUTED = (
    "Errors are evaluated on held-out episodes that are used nowhere else.",
    "Norms are recomputed after every solver: H2 by Lyapunov equations, H∞ by the bounded-real bisection.",
    "Weights are verified on the responses of every unit at all frequencies.",
    "Every artifact has a checksum; the same recordings and settings give the same bytes.",
)


def certificates(facts: Facts) -> Section | None:
    """Return certificates, assumptions and reasons; None where no observer was designed."""
    if not facts.observers:
        return None
    assumed = facts.entry.get("assumptions")
    more = [f"“{facts.label}” at run time: {'; '.join(assumed)}."] if assumed else []
    card = [("Assumptions", [*_ASSUMED, *more]), ("How it is verified", _RECOMPUTED)]
    return Section("certificates", "Certificates", [_TEXT], card, [_table(facts), _reasons(facts.observers)])


def _table(facts: Facts) -> Table | None:
    """Return one row an observer with a model."""
    rows, errors = [], facts.tables[0].cells if facts.tables else {}
    for name, entry in facts.observers.items():
        if entry.get("status") == "failed" or not split_name(name)[0]:
            continue
        radius, lower = entry.get("spectral_radius_max"), not label_of(name).baseline and entry.get("lower_bound")
        row: Row = {"observer": observer_label(name), "radius": radius and minus(radius_text(radius)), **entry}
        row |= {} if lower else {"lower_bound": None, "gap_percent": None}  # a baseline's optimum bounds no worst case
        row |= {("bound", c): bound for c, bound in entry.get("set_bound", {}).items()}
        rows.append(row | {("worst", c): cell.worst_rms for c, cell in errors.get(name, {}).items()})
    columns = [
        Column("observer"),
        Column("states of the filter", "order"),
        Column("spectral radius", "radius"),
        Column("H2 norm at most", "worst_case_h2", "set of plants"),
        Column("lower bound", "lower_bound", "set of plants"),
        Column("gap (%)", "gap_percent", "set of plants"),
    ]
    for channel in dict.fromkeys(c for row in rows for c in row.get("set_bound", {}) if c not in facts.measured):
        group = f"recorded signals: {facts.axis(channel)}"
        columns += [Column("bound", ("bound", channel), group), Column("worst RMS error", ("worst", channel), group)]
    columns.append(Column("gain at most", "relift_gain", "at run time"))
    return build("Certificates of all observers", columns, rows, facts.label, sortable=True)


def _reasons(entries: Mapping[str, ByName]) -> Table | None:
    """Return why an observer could not be designed or certified; observers with the same reason share a row."""
    reasons = dict[tuple[str, str], list[str]]()
    for name, entry in entries.items():
        first = "not designed" if entry.get("status") == "failed" else "set of plants"
        for kind, key in ((first, "reason"), ("recorded signals", "set_reason"), ("at run time", "relift_reason")):
            if entry.get(key):
                text = "; ".join(dict.fromkeys(entry[key].split("; ")))
                reasons.setdefault((kind, text), []).append(observer_label(name))
    rows = [{"observer": "; ".join(of), "without": kind, "reason": text} for (kind, text), of in reasons.items()]
    columns = [Column("observer"), Column("without"), Column("reason")]
    return build("Without a certificate, and why", columns, rows, prose=True, folded=True)
