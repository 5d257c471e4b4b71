"""Objects that show themselves: what their figures draw is compared with hand calculations and other libraries."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import kros
from kros.core.errors import ConfigError
from kros.data import Population
from kros.evaluate import fit_percent
from kros.identify.identified import IdentifiedModels
from kros.interop import to_control

PERIOD = 0.01


def recorded(unit: str = "V") -> Population:
    """Two units with white noise for signals."""
    rng = np.random.default_rng(0)
    arrays = {name: [rng.standard_normal((4000, 2)) for _ in range(2)] for name in ("a", "b")}
    population = kros.from_arrays(arrays, states=["x"], inputs=["u"], measured=["x"], sample_period_s=PERIOD)
    channels = (population.channels[0], type(population.channels[1])("u", "input", unit))
    return replace(population, columns=channels)


@pytest.fixture(scope="module")
def models() -> IdentifiedModels:
    motors = kros.plants.DcMotorPopulation(n_units=2, n_episodes=2, seconds=1.0, seed=3).simulate().population
    return kros.identify(motors, refine=False)


def test_the_fit_is_that_of_the_simulation(models: IdentifiedModels) -> None:
    recorded, estimate = np.array([[1.0], [2.0], [6.0]]), np.array([[1.0], [2.0], [4.0]])
    assert fit_percent(estimate, recorded)[0] == pytest.approx(100 * (1 - 2 / np.sqrt(14)))
    assert np.isnan(fit_percent(estimate, np.ones((3, 1)))[0])
    figure = models.plot("compare", unit=models.models().unit_ids[1])
    simulated, measured = (line.get_ydata() for line in figure.axes[4].lines[::-1])
    percent = fit_percent(simulated[:, None], measured[:, None])[0]
    assert figure.axes[5].get_title(loc="left") == f"fit {percent:.1f} %"
    with pytest.raises(ConfigError, match="unit 'x' has no episode in condition 'default'"):
        models.plot("compare", unit="x")


def test_the_phase_of_a_bode_plot_is_that_of_python_control(models: IdentifiedModels) -> None:
    one = models.models()
    panel = models.plot().axes[1]  # of the position
    freqs, phase = panel.collections[0].get_segments()[1].T
    response = to_control(one.systems([one.unit_ids[1]])[0])(np.exp(2j * np.pi * freqs * one.sample_period_s))
    assert np.allclose(np.exp(1j * np.radians(phase)), np.exp(1j * np.angle(response[0, 0])), atol=1e-6)


def test_summaries_are_short_and_escaped_in_html(models: IdentifiedModels) -> None:
    population = recorded(unit="<b>")
    text, html = population.summary(), population._repr_html_()
    assert "inputs      u (<b>)" in text.splitlines()
    assert "<td>u (&lt;b&gt;)</td>" in html
    assert "<b>" not in html
    uncertain = kros.quantify(models, n_freqs=50, max_order=1)
    design = kros.synthesize(uncertain, "kalman_tuned", methods=())
    for shown in (population, models, models.models(), uncertain, *uncertain.sets.values(), design, design.observer):
        lines = shown.summary().splitlines()
        assert lines[0] == type(shown).__name__
        assert 5 <= len(lines) <= 16
    assert design.observer.plot(models=models).axes[4].lines[1].get_label() == "linear (EDMD), tuned Kalman"
