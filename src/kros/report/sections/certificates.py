"""What is certified about every observer, under which assumptions, and how it was recomputed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ...core.linalg import radius_text
from ..content import Column, Section, Table, build
from ..error_tables import ErrorCell, ErrorTable, error_tables
from ..names import BASELINES, axis_label, minus, observer_label, split_observer
from ..verdict import measured_of

Facts = Mapping[str, Any]
_TEXT = (
    "For the set of plants: a bound on the H2 norm of the error for every plant between the weights, and a lower bound "
    "for corrections of this kind. For recorded signals: a bound on the RMS error for all signals with at most the recorded "
    "power in every band of frequency, beside the worst RMS error on held-out episodes. At run time: a bound on the gain "
    "from the model's one-step residual to the error, with the state re-lifted at every step."
)
_ASSUMED = (
    "The recorded units represent those to come: another batch and wear are not covered.",
    "The recorded motion did not depend on any estimate. The certificates do not hold if a controller uses the estimate.",
    "The set of plants: every machine is the nominal model perturbed by at most the weights, in one form.",
    "The recorded signals: residuals have at most the recorded power in every band of frequency.",
    "Errors are those relative to the recorded sensors, unless the true signal is known.",
)
_RECOMPUTED = (
    "Errors are evaluated on held-out episodes that are used nowhere else.",
    "Norms are recomputed after every solver: H2 by Lyapunov equations, H∞ by the bounded-real bisection.",
    "Weights are verified on the responses of every unit at all frequencies.",
    "Every artifact has a checksum; the same recordings and settings give the same bytes.",
)


def certificates(metrics: Facts) -> Section | None:
    """Return certificates, assumptions and reasons; None where no observer was designed."""
    entries = metrics.get("observers")
    if not entries:
        return None
    tables = error_tables(metrics)
    deployed = metrics["study"].get("deployed")
    designed = {name: own for name, own in entries.items() if own.get("status") != "failed" and split_observer(name)[0]}
    assumed = entries.get(deployed, {}).get("assumptions")
    more = [f"“{observer_label(deployed)}” at run time: {'; '.join(assumed)}."] if deployed and assumed else []
    lists = [("Assumptions", [*_ASSUMED, *more]), ("How it is verified", _RECOMPUTED)]
    shown = [_table(designed, tables[0] if tables else None, metrics), _reasons(entries)]
    return Section("certificates", "Certificates", [_TEXT], tables=shown, lists=lists)


def _table(entries: Facts, errors: ErrorTable | None, metrics: Facts) -> Table | None:
    """Return one row an observer."""
    own, units = list(entries.values()), metrics["study"].get("channels", {})
    bounds = [None if n in _baselines(entries) else e.get("lower_bound") or None for n, e in entries.items()]
    radii = [e.get("spectral_radius_max") for e in own]
    columns = [
        Column("observer", [observer_label(name) for name in entries]),
        Column("states of the filter", [e.get("order") for e in own]),
        Column("spectral radius", [None if r is None else minus(radius_text(r)) for r in radii]),
        Column("H2 norm at most", [e.get("worst_case_h2") for e in own], "set of plants"),
        Column("lower bound", bounds, "set of plants"),
        Column(
            "gap (%)", [e.get("gap_percent") if b else None for e, b in zip(own, bounds, strict=True)], "set of plants"
        ),
    ]
    channels = list(dict.fromkeys(c for e in own for c in e.get("set_bound") or {} if c not in measured_of(metrics)))
    for channel in channels:
        cells = [(errors.cells.get(n, {}) if errors else {}).get(channel, ErrorCell()) for n in entries]
        group = f"recorded signals: {axis_label(channel, units.get(channel, ''))}"
        columns.append(Column("bound", [(e.get("set_bound") or {}).get(channel) for e in own], group))
        columns.append(Column("worst RMS error", [cell.worst_rms for cell in cells], group))
    columns += [
        Column("gain at most", [e.get("relift_gain") for e in own], "at run time"),
        Column("loss rate certified", [_lost(e) for e in own], "at run time"),
    ]
    deployed = metrics["study"].get("deployed")
    caption = "Certificates of all observers"
    return build(caption, columns, observer_label(deployed) if deployed else None, sortable=True)


def _baselines(entries: Facts) -> set[str]:
    """Return the baselines, whose own optimum bounds nothing in the worst case."""
    return {name for name in entries if split_observer(name)[1] in BASELINES}


def _lost(entry: Facts) -> str:
    """Return the declared loss rate, and whether it is certified."""
    if entry.get("dropout_rate") is None:
        return ""
    return f"{100 * entry['dropout_rate']:g} %: {'yes' if entry.get('dropout_certified') else 'no'}"


def _reasons(entries: Facts) -> Table | None:
    """Return why an observer could not be designed or certified; observers with the same reason share a row."""
    reasons: dict[tuple[str, str], list[str]] = {}
    for name, own in entries.items():
        kinds = [
            "not designed" if own.get("status") == "failed" else "set of plants",
            "recorded signals",
            "at run time",
        ]
        for kind, key in zip(kinds, ("reason", "set_reason", "relift_reason"), strict=True):
            if own.get(key):
                text = "; ".join(dict.fromkeys(own[key].split("; ")))
                reasons.setdefault((kind, text), []).append(observer_label(name))
    columns = [
        Column("observer", ["; ".join(names) for names in reasons.values()]),
        Column("without", [kind for kind, _ in reasons]),
        Column("reason", [text for _, text in reasons]),
    ]
    return build("Without a certificate, and why", columns, prose=True, folded=True)
