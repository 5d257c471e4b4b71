"""Observers with a memory in a study: what they lift, what they are tuned on, when the tuned one is kept, and what is said where there is none."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from kros.design.certificates import certify_running, other_conditions
from kros.design.methods.design import design
from kros.design.settings import PredictorSettings, SynthesisSettings
from kros.design.task import DesignTask
from kros.design.uncertain_set import certificate
from kros.design.validation import TrainingSet, hidden_mean
from kros.lifting import Lifting
from kros.observer import Sensor
from kros.plants import PLANTS

STATES, INPUTS = ("position", "velocity", "current"), ("target_position", "target_velocity")
DRIVE = Lifting(STATES, ("sin(100*position + phase)",), ("phase",))


@pytest.fixture(scope="module")
def tuning():
    made = PLANTS["harmonic-drive"](n_units=3, n_episodes=3, seconds=3.0, seed=1).simulate()
    truth = made.truth.as_dict()["units"]
    keys = tuple(k for k in made.population.episodes if k.condition == "noload")
    return TrainingSet(
        made.population, keys, {u: {"phase": truth[u]["phase_rad"][0]} for u in made.population.unit_ids}
    )


def task(tuning, lifting=DRIVE, measured=(0,), name="koopman/memory", method="memory", **settings):
    models = SimpleNamespace(
        name="koopman",
        lifting=lifting,
        measured=measured,
        recorded_inputs=INPUTS,
        input_scale=np.array([6.0, 3.0]),
        output_scale=np.array([6.0, 3.0, 0.3, 1.0])[: lifting.n_lifted],
        sample_period_s=0.001,
        parameters={"phase": np.zeros(1)} if lifting.parameters else {},
        A=np.zeros((1, lifting.n_lifted, lifting.n_lifted)),
        B=np.zeros((1, lifting.n_lifted, 2)),
        index=lambda unit: 0,
    )
    options = {
        "settings": SynthesisSettings(**settings),
        "predictor": PredictorSettings(effort="quick", states=4, steps=2),
    }
    return DesignTask(name, method, models, "001001", None, "there is no set", np.array([1e-5]), tuning, **options)


@pytest.fixture(scope="module")
def made(tuning):
    own = task(tuning)
    return own, design(own)


def test_a_study_makes_an_observer_and_says_how(made, tuning):
    _, product = made
    assert product.facts["memory_states"] == 4
    assert set(product.facts["held_out_percent"]) == {"before", "after"}
    memory = product.facts["memory"]
    assert memory["effort"] == "quick"
    assert memory["delays"] == 40
    assert set(memory["conditions"]) == {"noload"}  # of three episodes of one condition
    assert set(memory["left_out_percent"]) == {"velocity", "current"}
    observer = product.observer
    assert observer.recorded == STATES
    assert observer.lifting.functions == ("sin(100*position + phase)", "cos(100*position + phase)")
    judge = tuning.read()
    assert max(judge.percent(observer)) < 20


def test_told_of_the_sensor_it_is_better_than_untold_and_certified(made, tuning):
    own = task(replace(tuning, sensor={"position": Sensor(noise=6e-5, delay_samples=1, dropout=0.05)}))
    told, untold, data = design(own), made[1].observer, own.training.read()
    assert told.observer.runtime.delay == 1
    assert told.observer.sensor == own.sensor
    better, worse = data.percent(told.observer)[1:], data.percent(untold)[1:]
    assert (better < 0.5 * worse).all()
    running = certify_running(own, [told])[0]
    assert running.certificate.certified
    assert running.rows
    assert all(row.holds for row in running.rows)


def test_it_is_certified_as_it_runs_and_its_order_counts_the_memory(made):
    own, product = made
    running = certify_running(own, [product])[0]
    assert running.certificate.certified
    assert running.rows
    assert all(row.holds for row in running.rows)
    assert running.dropout_percent < 100


def test_observers_are_compared_in_all_conditions_and_certified_in_one(made, tuning):
    own, product = made
    everything = replace(own, recordings=replace(tuning, keys=tuple(tuning.population.episodes)))
    (loaded,) = other_conditions(everything)
    assert {key.condition for key in loaded.batch.keys} == {"load"}
    assert other_conditions(own) == []
    home, both = (certify_running(task, [product])[0] for task in (own, everything))
    away = hidden_mean(loaded.percent(product.observer), (0,))
    assert both.hidden_percent == pytest.approx(np.sqrt(home.hidden_percent * away), rel=1e-9)
    assert both.certificate.gain == home.certificate.gain
    facts = certificate(own, product, None)
    assert facts["order"] == 4
    assert "states of its own" in facts["reason"]


@pytest.mark.parametrize(
    ("lifting", "measured", "words"),
    [
        (Lifting(STATES, ("sin(velocity)",)), (0,), "should read position alone"),
        (Lifting(STATES, ("position[-1]",)), (0,), "functions of the lifting should read"),
        (Lifting(STATES, (), (), INPUTS, ("position*target_velocity",)), (0,), "functions of the lifting should read"),
        (Lifting(STATES), (0, 1, 2), "needs a state that is not measured"),
        (Lifting((*STATES[:2], "memory_1")), (0,), "names of states and parameters must differ"),
    ],
)
def test_where_there_is_none_the_reason_is_told(tuning, lifting, measured, words):
    product = design(task(tuning, lifting, measured))
    assert product.synthesis is None
    assert product.facts["status"] == "failed"
    assert words in product.facts["reason"]
