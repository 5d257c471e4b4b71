"""The notebooks of the documentation run as they are, and what they show is so."""

import runpy
import warnings
from pathlib import Path

import matplotlib as mpl
import pytest

NOTEBOOKS = Path(__file__).parents[2] / "examples" / "notebooks"


@pytest.fixture
def run(monkeypatch):
    """Run a notebook without a display, and return its names."""

    def run(name):
        import matplotlib.pyplot as plt

        monkeypatch.setattr(plt, "show", lambda: plt.close("all"))
        with mpl.rc_context({"backend": "agg"}), warnings.catch_warnings():
            warnings.simplefilter("error")
            return runpy.run_path(str(NOTEBOOKS / f"{name}.py"))

    return run


@pytest.mark.slow
def test_own_data(run):
    found = run("own_data")
    worst_case, estimator, difference = found["errors"].values()
    assert estimator < 0.25 * min(worst_case, difference)
    assert found["found"].cover_max <= 1
    assert found["design"].certificate.certified


@pytest.mark.slow
def test_control_models(run):
    found = run("control_models")
    assert len(found["largest"]) == 8
    assert 0.99 < max(found["largest"].values()) <= 1  # recomputed in the notebook, with a finer grid
    form = found["Form"].OUTPUT_MULTIPLICATIVE
    assert found["found"].peak_db[form] < -10
    assert found["found"].misfit_max < 1e-9


def test_every_notebook_is_tested_and_in_the_documentation():
    names = {path.stem for path in NOTEBOOKS.glob("*.py")}
    assert names == {"own_data", "control_models"}
    index = (NOTEBOOKS.parents[1] / "docs" / "index.md").read_text(encoding="utf-8")
    assert [name for name in names if f"<notebooks/{name}>" not in index] == []
