"""Objects that show themselves: what their figures draw is compared with hand calculations and other libraries."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter

import kros
from kros.core.errors import ConfigError
from kros.data import Population
from kros.evaluate import fit_percent
from kros.evaluate.validation import correlation, excitation
from kros.identify.identified import IdentifiedModels
from kros.interop import to_control
from kros.report.canvas import thin
from kros.report.theme import DRAWING

PERIOD = 0.01


def recorded(noise: float, unit: str = "V", seed: int = 0, **inputs: Any) -> Population:
    """Two units of ``x+ = 0.5 x + u``, driven by white noise, with white noise of a standard deviation on x."""
    rng = np.random.default_rng(seed)

    def episode() -> np.ndarray:
        u = inputs.get("u", rng.standard_normal(4000))
        x = lfilter([0, 1], [1, -0.5], u)
        return np.column_stack([x + noise * rng.standard_normal(len(u)), u])

    arrays = {name: [episode(), episode()] for name in ("a", "b")}
    population = kros.from_arrays(arrays, states=["x"], inputs=["u"], measured=["x"], sample_period_s=PERIOD)
    channels = (population.channels[0], type(population.channels[1])("u", "input", unit))
    return replace(population, columns=channels)


@pytest.fixture(scope="module")
def models() -> IdentifiedModels:
    motors = kros.plants.DcMotorPopulation(n_units=2, n_episodes=2, seconds=1.0, seed=3).simulate().population
    return kros.identify(motors, refine=False)


def test_the_coherence_of_a_linear_system_is_one_and_falls_with_noise() -> None:
    levels = []
    for noise in (0.0, 1.0):
        population = recorded(noise)
        freqs, power, coherence = excitation(population, population.keys("a"), 256, 8)
        levels.append(coherence[1, 0, 2:].min())
        if noise:  # coherence is |G|^2 / (|G|^2 + noise): for equal powers
            gain = 1 / np.abs(np.exp(2j * np.pi * freqs * PERIOD) - 0.5) ** 2
            assert np.mean(np.abs(coherence[1, 0] - gain / (gain + noise**2))) < 0.06
            assert np.median(power[1]) == pytest.approx(2 * PERIOD, rel=0.1)  # one-sided, of unit variance
    assert levels[0] > 0.98 > 0.6 > levels[1]


def test_the_spectrum_of_a_constant_input_is_not_drawn() -> None:
    figure = recorded(0.1, u=np.ones(400)).plot("excitation", unit="b")
    assert np.isnan(figure.axes[0].lines[0].get_ydata()).all()
    assert np.isnan(figure.axes[1].lines[0].get_ydata()).all()


def test_the_autocorrelation_of_white_noise_is_in_its_band() -> None:
    noise = np.random.default_rng(1).standard_normal((200, 500))
    values = np.array([correlation(row, row, 25) for row in noise])
    assert np.allclose(values[:, 0], 1)
    assert 0.98 < np.mean(np.abs(values[:, 1:]) < 2.5758 / np.sqrt(500)) < 0.998
    x, y = noise[:2, :300]
    lag = 7
    x, y = x - x.mean(), y - y.mean()
    by_hand = np.sum(x[lag:] * y[:-lag]) / np.sqrt(np.sum(x**2) * np.sum(y**2))
    assert correlation(x, y, 10)[lag] == pytest.approx(by_hand, abs=1e-12)
    assert np.isnan(correlation(np.ones(5), np.arange(5.0), 2)).all()


def test_residuals_of_the_true_model_are_white() -> None:
    rng = np.random.default_rng(2)
    u, w = rng.standard_normal((2, 4, 3000))
    x = lfilter([0, 1], [1, -0.5], u + 0.1 * w)
    arrays = {"a": list(np.stack([x, u], axis=-1)[:2]), "b": list(np.stack([x, u], axis=-1)[2:])}
    names = {"states": ["x"], "inputs": ["u"], "measured": ["x"]}
    identified = kros.identify(kros.from_arrays(arrays, sample_period_s=PERIOD, **names), refine=False)
    auto, cross = identified.plot("residuals").axes
    values = np.array([line[1, 1] for line in auto.collections[0].get_segments()])
    assert values[0] == pytest.approx(1)
    band = auto.patches[0].get_height() / 2
    assert band == pytest.approx(2.5758 / np.sqrt(2999), rel=1e-4)
    others = np.concatenate([values[1:], [line[1, 1] for line in cross.collections[0].get_segments()]])
    assert np.sum(np.abs(others) > band) <= 2
    assert len(values) == DRAWING.lags + 1


def test_the_fit_is_that_of_the_simulation(models: IdentifiedModels) -> None:
    recorded, estimate = np.array([[1.0], [2.0], [6.0]]), np.array([[1.0], [2.0], [4.0]])
    assert fit_percent(estimate, recorded)[0] == pytest.approx(100 * (1 - 2 / np.sqrt(14)))
    assert np.isnan(fit_percent(estimate, np.ones((3, 1)))[0])
    figure = models.plot("compare", unit=models.models().unit_ids[1])
    simulated, measured = (line.get_ydata() for line in figure.axes[4].lines[::-1])
    percent = fit_percent(simulated[:, None], measured[:, None])[0]  # of a line of all samples: the episode is short
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
    population = recorded(0.1, unit="<b>")
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


def test_a_thinned_line_ends_with_its_last_samples() -> None:
    time = np.arange(899.0)
    x, y = thin(time, np.sin(time))
    assert np.diff(x).max() < 2 * np.ceil(899 / DRAWING.points)
    assert (x[-1], len(x) <= 2 * DRAWING.points + 1) == (898.0, True)
    assert y[-1] == np.sin(898.0)
