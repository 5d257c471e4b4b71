"""Observers on units that took no part in identification, uncertainty, synthesis, tuning or training, over simulated populations.

    python benchmarks/leave_one_out.py --loop stiff soft --spread 1 3 --units 12 --folds 3 --out populations/

Every population is simulated and studied with ``[evaluate] folds``, with kros's models and with the paper's: for each fold the whole study is made on
the other units. Prints a table for
every condition: in how many folds an observer is certified as it runs ("runs") and for the uncertain set ("set"), and in how many it could be made
where not in all; mean over the units with the 95 % interval of a bootstrap over units, and the worst unit, of the states that are not measured, in
percent of the largest value; power of the error around the gearbox frequency in dB relative to the paper's own observer, `koopman_edmd/mixed`. Below it:
what is asked of the table, and by how much it is met or missed. ``--set KEY=VALUE`` changes the study; with ``--out`` runs are kept, and found done
the next time (``kros run`` on a population's study.toml adds the report).
"""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
import time
import traceback
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain, product
from math import inf, sqrt
from pathlib import Path
from typing import Any

import numpy as np

import kros
from kros.core.artifacts import write_json
from kros.data import write_parquet
from kros.design.task import split_name
from kros.evaluate import unit_interval
from kros.plants import HarmonicDrivePopulation
from kros.report.facts import ErrorCell, ErrorTable
from kros.report.facts import Facts as Metrics
from kros.report.names import label_of, minus, number
from kros.study import load_config
from kros.study.config import Stage
from kros.study.engine.executors import Lines, available_cores

PAPER = "koopman_edmd/mixed"  # the observer that powers at the gearbox frequency are compared with
HOME, HIDDEN, LEARNED, ENTRYWISE = "noload", ("velocity", "current"), "learned", "koopman_edmd/paper"
SHOWN = (
    *("koopman/open_loop", "koopman/kalman_tuned", "koopman/ekf", "filtered_difference", LEARNED),
    *(
        PAPER,
        ENTRYWISE,
        "linear_edmd/paper",
        "koopman/worst_case_h2",
        "koopman/residual_h2",
        "koopman_edmd/residual_h2",
    ),
    *("linear/residual_h2", "koopman/estimator", "linear/estimator"),
)
# Baselines are the same in both studies, so the second one has none.
PAPERS = (
    '[identify]\nrefine = false\n[synthesis]\nmethods = ["paper", "mixed", "residual_h2"]\n[observer]\nbaselines = []\n'
)
STUDIES = {"run": "", "paper": PAPERS}
Facts = Mapping[str, Mapping[str, Any]]


def main() -> None:
    """Run all populations, print their tables, and in the end what is met."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--loop", choices=["stiff", "soft"], nargs="+", default=["stiff", "soft"])
    parser.add_argument("--spread", type=float, nargs="+", default=[1.0, 3.0])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--units", type=int, default=12)
    parser.add_argument("--episodes", type=int, default=6)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--folds", type=int, default=3)
    parser.add_argument("--workers", type=int, default=available_cores())
    parser.add_argument("--set", metavar="KEY=VALUE", action="append", default=[])
    parser.add_argument("--out", type=Path)
    parser.add_argument(
        "--markdown", action="store_true", help="print tables as in docs/experiments.md, of the observers named there"
    )
    options = parser.parse_args()
    verdicts = []
    with tempfile.TemporaryDirectory() as scratch:
        for loop, spread in product(options.loop, options.spread):
            title = (
                f"{loop} loop, spread {spread:g}, seed {options.seed}, {options.units} units in {options.folds} folds"
            )
            say(f"\n{title} ...")
            began = time.perf_counter()
            try:
                left_out = studied(
                    (options.out or Path(scratch)) / f"{loop}-{spread:g}-{options.seed}", loop, spread, options
                )
            except Exception as error:  # whatever it is: the populations that follow are run all the same
                say(traceback.format_exc())
                verdicts.append((title, [f"failed: {error}"]))
                continue
            say(f"{title} ({time.perf_counter() - began:.0f} s)")
            tables = left_out_tables(left_out["rows"], HOME)
            if options.markdown:
                say("\n".join(["", *markdown(tables, left_out["observers"], options.folds), ""]))
            for table in [] if options.markdown else tables:
                show(table, left_out["observers"], options.folds)
            verdicts.append((title, asked({t.condition: t for t in tables}, left_out["observers"], options.folds)))
            say("\n".join(verdicts[-1][1]))
    say("\nIn short")
    for title, lines in verdicts:
        say("\n".join([title, *lines]))


@dataclass(frozen=True)
class LeftOutCell(ErrorCell):
    """Error on units left out, with the power around the gearbox frequency relative to that of `PAPER`, dB."""

    band_db: float | None = None


def left_out_tables(rows: Sequence[Mapping[str, Any]], home: str) -> list[ErrorTable]:
    """Return the errors with 95 % intervals of the mean over units, and with powers around the gearbox frequency."""
    grouped: dict[tuple[str, str, str], list[Mapping[str, Any]]] = {}
    for row in rows:
        grouped.setdefault((row["observer"], row["condition"], row["channel"]), []).append(row)
    intervals = []
    for group in grouped.values():
        errors = [row["error_percent"] for row in group]
        if len(errors) > 1 and None not in errors:
            intervals.append({**group[0], "interval": unit_interval(errors)})
    tables = []
    for table in Metrics({"study": {"identify_on": home}}).tables_of(rows, intervals):
        cells = {
            name: {
                c: LeftOutCell(
                    **vars(cell),
                    band_db=_band_db(grouped[name, table.condition, c], grouped.get((PAPER, table.condition, c), [])),
                )
                for c, cell in channels.items()
            }
            for name, channels in table.cells.items()
        }
        tables.append(replace(table, cells=cells))
    return tables


def _band_db(rows: Sequence[Mapping[str, Any]], published: Sequence[Mapping[str, Any]]) -> float | None:
    """Return the ratio of mean powers around the gearbox frequency over the units that both have, dB."""
    powers, others = ({r["unit"]: r.get("gearbox_band_power") for r in part} for part in (rows, published))
    pairs = np.array([[powers[unit], others[unit]] for unit in powers if unit in others], float)
    if not pairs.size or not np.isfinite(pairs).all() or not pairs.sum(axis=0).all():
        return None
    mean = pairs.mean(axis=0)
    return float(10 * np.log10(mean[0] / mean[1]))


def studied(folder: Path, loop: str, spread: float, options: argparse.Namespace) -> dict[str, Any]:
    """Simulate and study a population; return what is known about units that were left out."""
    recordings = folder / "recordings"
    if not (recordings / "population.json").exists():  # written last
        shutil.rmtree(recordings, ignore_errors=True)
        sizes = options.units, options.episodes, options.seconds, options.seed
        drives = HarmonicDrivePopulation(*sizes, spread=spread, loop=loop).simulate().population
        write_parquet(drives, recordings)
    both: dict[str, Any] = {"rows": [], "observers": {}}
    for name, settings in STUDIES.items():
        study = folder / f"{name}.toml"
        study.write_text(
            f'[data]\nsource = "recordings"\nreader = "parquet"\n[evaluate]\nfolds = {options.folds}\n{settings}'
        )
        config = load_config(study, options.set)
        result = kros.run(config, folder / name, until=Stage.LEFT_OUT, workers=options.workers, progress=Lines())
        left_out: dict[str, Any] = result.metrics["left_out"]
        for fold, reason in left_out["failed"].items():
            say(f"{name}, fold {fold} failed: {reason}")
        both = {"rows": both["rows"] + left_out["rows"], "observers": both["observers"] | left_out["observers"]}
    write_json(folder / "left_out.json", both)
    return both


def show(table: ErrorTable, facts: Facts, folds: int) -> None:
    """Print one condition."""
    channels = [c for c in HIDDEN if any(c in cells for cells in table.cells.values())]
    say(
        f"\n{table.condition:31s} {'':>5s} {'certified':>11s} "
        + " ".join(f"{f'{c}, % of the largest value':>45s}" for c in channels)
    )
    columns = f"{'mean':>8s} {'(95 %)':>18s} {'worst':>8s} {'band dB':>8s}"
    say(f"{'observer':31s} {'order':>5s} {'runs':>5s} {'set':>5s} " + " ".join([columns] * len(channels)))
    for name, cells in table.cells.items():
        own = facts[name]
        orders = "/".join(map(str, own["orders"])) or "-"
        proofs = [f"{own[key]}/{folds}" if own[key] is not None else "-" for key in ("relift_certified", "robust")]
        made = name if own["made"] == folds else f"{name} ({own['made']}/{folds})"
        say(
            f"{made:31s} {orders:>5s} {proofs[0]:>5s} {proofs[1]:>5s} "
            + " ".join(numbers(cells.get(c)) for c in channels)
        )


def rounded(cell: ErrorCell | None) -> str:
    """Return mean, interval and worst unit to three digits."""
    if cell is None or cell.mean is None:
        return "– | –" if cell is None else "diverged | –"
    return f"{number(cell.mean)} ({'–'.join(map(number, cell.interval))}) | {number(cell.worst)}"


def numbers(cell: ErrorCell | None) -> str:
    """Return the numbers of one channel."""
    if cell is None:
        return f"{'-':>45s}"
    if cell.mean is None:
        return f"{'diverged':>45s}"
    power = getattr(cell, "band_db", None)
    band = f"{power:8.1f}" if power is not None else f"{'-':>8s}"
    return f"{cell.mean:8.4f} {'({:.4f}, {:.4f})'.format(*cell.interval):>18s} {cell.worst:8.4f} {band}"


def markdown(tables: list[ErrorTable], facts: Facts, folds: int) -> list[str]:
    """Return the rows of a table for people: velocity and current at home, velocity elsewhere, powers around the gearbox frequency at home."""
    places = [(tables[0], "velocity"), (tables[0], "current"), *((table, "velocity") for table in tables[1:])]
    head = [f"{channel}, {table.condition} | worst" for table, channel in places]
    lines = [
        " | ".join(["| observer | states | runs | set", *head, "band, velocity | current |"]),
        "|---" * (2 * len(places) + 6) + "|",
    ]
    for name in (n for n in SHOWN if n in tables[0].cells):
        own, cells = facts[name], tables[0].cells[name]
        made = "" if own["made"] == folds else f" ({own['made']}/{folds})"
        row = [f"`{name}`{made}", "/".join(map(str, own["orders"])) or "–"]
        row += ["–" if own[key] is None else f"{own[key]}/{folds}" for key in ("relift_certified", "robust")]
        row += [rounded(table.cells[name].get(channel)) for table, channel in places]
        bands = [getattr(cells.get(c), "band_db", None) for c in HIDDEN]
        row += ["–" if b is None else minus(f"{b:.1f}") for b in bands]
        lines.append(f"| {' | '.join(row)} |")
    return lines


def asked(tables: Mapping[str, ErrorTable], facts: Facts, folds: int) -> list[str]:
    """Return what is asked of a population's tables, each with whether it is met."""
    lines: list[str] = []
    for key, what in (("robust", "for the set"), ("relift_certified", "as it runs")):
        certified = [n for n in tables[HOME].cells if facts[n][key] == folds]
        chosen = min((n for n in certified if own(n)), key=lambda n: both(tables[HOME], n), default=None)
        lines += best_of_certified(tables[HOME], certified, chosen, facts, f"(a) certified {what} in all folds")
    if chosen is None:
        return lines
    in_velocity = min((n for n in certified if own(n)), key=lambda n: worst(tables[HOME], n, "velocity"))
    compared = [against_paper(tables, n) + against_learned(tables, n) for n in dict.fromkeys((chosen, in_velocity))]
    return [*lines, *chain.from_iterable(compared)]


def own(name: str) -> bool:
    """Tell whether an observer is kros's own: no baseline, and not the paper's."""
    return not label_of(name).baseline and split_name(name)[1] not in ("mixed", "paper")


def worst(table: ErrorTable, name: str, channel: str) -> float:
    """Return the error of the worst unit; infinite where there is none."""
    cell = table.cells.get(name, {}).get(channel)
    return inf if cell is None or cell.worst is None else cell.worst


def mean(table: ErrorTable, name: str, channel: str) -> float:
    """Return the mean error; infinite where there is none."""
    cell = table.cells.get(name, {}).get(channel)
    return inf if cell is None or cell.mean is None else cell.mean


def both(table: ErrorTable, name: str) -> float:
    """Return the geometric mean of the worst units' errors in velocity and current."""
    return sqrt(worst(table, name, "velocity") * worst(table, name, "current"))


def best_of_certified(
    table: ErrorTable, certified: list[str], chosen: str | None, facts: Facts, what: str
) -> list[str]:
    """How far kros's best certified observer is from the best certified one of all, and which uncertified ones beat it."""
    if chosen is None:
        return [f"{what}: none of kros's own {met(False)}"]
    lines = [f"{what}, kros's best on the worst unit: {chosen}"]
    for channel in HIDDEN:
        reached, first = worst(table, chosen, channel), min(certified, key=lambda n: worst(table, n, channel))
        ratio = reached / worst(table, first, channel)
        beside = "the best of all" if ratio <= 1 else f"{ratio:.3f} times that of {first}"
        lines.append(f"(a) {channel} of the worst unit: {reached:.4f}, {beside} {met(ratio <= 1)}")
        for name in table.cells:
            if name not in certified and worst(table, name, channel) < reached:
                reasons = (
                    "; ".join(facts[name]["reasons"])
                    or "it is no constant correction of a model, and certificates are about these"
                )
                lines.append(f"    better without: {name} {worst(table, name, channel):.4f} ({reasons[:200]})")
    return lines


def against_paper(tables: Mapping[str, ErrorTable], name: str) -> list[str]:
    """Errors and powers beside those of the paper's own observer."""
    lines, papers = [], [n for n in (PAPER, ENTRYWISE) if n in tables[HOME].cells]
    for paper, (channel, times) in product(papers, (("current", 3.0), ("velocity", 4.0))):
        theirs, ours = (tables[HOME].cells[n][channel].mean for n in (paper, name))
        ratio = (theirs or inf) / (ours or inf)
        lines.append(
            f"(b) {channel} of {paper} over that of {name}: {ratio:.2f}, asked {times:g} {met(ratio >= times)}"
        )
    for condition, table in tables.items():
        for channel in HIDDEN:
            found = getattr(table.cells[name][channel], "band_db", None)
            text = "unknown" if found is None else f"{found:.1f} dB"
            lines.append(
                f"(b) gearbox band, {condition}, {channel} of {name}: {text}, asked -10 dB {met(found is not None and found <= -10)}"
            )
    return lines


def against_learned(tables: Mapping[str, ErrorTable], name: str) -> list[str]:
    """Errors beside those of the learned estimator."""
    lines = []
    for condition, channel, most in (*((c, "velocity", 1.0) for c in tables), (HOME, "current", 1.1)):
        for what, value in (("mean", mean), ("worst", worst)):
            ratio = value(tables[condition], name, channel) / value(tables[condition], LEARNED, channel)
            lines.append(
                f"(c) {condition}, {channel} of {name}, {what}: {ratio:.3f} of the learned estimator's, asked {most:g} {met(ratio <= most)}"
            )
    return lines


def met(yes: bool) -> str:
    """Return a verdict."""
    return "[met]" if yes else "[MISSED]"


def say(text: str) -> None:
    """Print at once."""
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
