"""The paper's study among the examples: its settings are those that are published, and its table of claims agrees with metrics.json."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from kros.study import load_config

EXAMPLE = Path(__file__).parents[2] / "examples" / "motor_drives"


@pytest.fixture
def claims(monkeypatch: pytest.MonkeyPatch):
    """The module of the table."""
    monkeypatch.syspath_prepend(EXAMPLE)
    import claims

    return claims


def test_settings_are_the_published_ones():
    study = load_config(EXAMPLE / "study.toml")
    assert (study.identify.alpha, study.lifting.functions) == (90.0, ("sin(100*position + phase)",))
    assert (study.uncertainty.form, study.data.reader) == ("inverse_input_multiplicative", "motor-drive-raw")


def test_claims_are_those_of_the_run(claims, paper):
    metrics = json.loads((paper / "metrics.json").read_text())
    found = list(claims.claims(metrics))
    assert all(section and claim and answer for section, claim, answer in found)
    assert [len(row.split(" | ")) for row in claims.table(metrics).splitlines()] == [3] * (len(found) + 2)

    def band(kind):
        rows = [r for r in metrics["evaluation"] if r["observer"] == f"{kind}/mixed" and r["role"] == "off_nominal"]
        return np.mean(
            [r["gearbox_band_power"] for r in rows if r["channel"] == "current" and r["condition"] == "noload"]
        )

    ratio = 10 * math.log10(band("koopman_edmd") / band("linear_edmd"))
    (ripple,) = [answer for _, claim, answer in found if "off-nominal" in claim and "gearbox" in claim]
    assert ripple.endswith(f"current {ratio:+.1f} dB")
    assert ratio < 0


def test_the_study_begins_on_simulated_drives(example, tmp_path):
    small = ["--units", 2, "--episodes", 2, "--seconds", 5, "--set", "identify.refine=false"]
    script, run = "motor_drives/run.py", tmp_path / "run"
    example(script, "--out", run, *small, "--until", "identify", "--workers", 1)
    assert (run / "models" / "koopman_edmd" / "model.json").is_file()
    published = ["--recordings", tmp_path / "run-recordings"]
    example(script, "--out", tmp_path / "again", *published, "--until", "read", "--workers", 1)
    assert (tmp_path / "again" / "population" / "facts.json").is_file()
