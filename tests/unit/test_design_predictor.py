"""Observers with a memory in a study: what they lift, what they are tuned on, when the tuned one is kept, and what is said where there is none."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from kros.core.errors import DataError
from kros.data.population import EpisodeKey
from kros.design.certificates import certify_running, other_conditions
from kros.design.methods.design import design
from kros.design.methods.predictor import EFFORTS, Plan, on_the_circle, recordings
from kros.design.methods.tuned import held_out, tuned_where_better
from kros.design.settings import PredictorSettings, SynthesisSettings
from kros.design.task import DesignTask
from kros.design.uncertain_set import certificate
from kros.design.validation import TrainingSet, hidden_mean
from kros.lifting import Lifting
from kros.observer import Sensor, relift_certificate
from kros.observer.limits import Limit
from kros.observer.predictor.choice import _held_out
from kros.plants import PLANTS
from kros.report.verdict import verdict

STATES, INPUTS = ("position", "velocity", "current"), ("target_position", "target_velocity")
DRIVE = Lifting(STATES, ("sin(100*position + phase)",), ("phase",))


@pytest.fixture(scope="module")
def tuning():
    made = PLANTS["harmonic-drive"](n_units=3, n_episodes=3, seconds=3.0, seed=1).simulate()
    truth = made.truth.as_dict()["units"]
    keys = tuple(k for k in made.population.episodes if k.condition == "noload")
    return TrainingSet(made.population, keys, {u: {"phase": truth[u]["phase_rad"][0]} for u in made.population.unit_ids})


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
    options = {"settings": SynthesisSettings(**settings), "predictor": PredictorSettings(effort="quick", states=4, steps=2)}
    return DesignTask(name, method, models, "001001", None, "there is no set", np.array([1e-5]), tuning, **options)


@pytest.fixture(scope="module")
def made(tuning):
    own = task(tuning)
    return own, design(own)


def test_a_calibrated_angle_is_seen_as_a_whole():
    functions = ("sin(100*position + phase)", "sin(position)", "cos(2*position - phase)", "sin(position + phase)*velocity")
    found = on_the_circle(Lifting(STATES, functions, ("phase",)))
    assert found.functions == (*functions, "cos(100*position + phase)", "sin(2*position - phase)")
    assert on_the_circle(found) == found
    assert on_the_circle(Lifting(STATES)) == Lifting(STATES)


def test_the_last_episodes_are_held_out():
    def keys(*names):
        return [EpisodeKey(name[0], "on", name[1:]) for name in names]

    assert held_out(keys("a1", "a2", "a3", "b1", "b2")) == [False, False, True, False, True]
    assert held_out(keys("a1", "b1", "c1", "d1")) == [False, False, True, False]
    assert held_out(keys("a1", "b1")) == [False, True]
    twice = [*keys("a1", "a2"), EpisodeKey("a", "off", "1"), EpisodeKey("a", "off", "2")]
    assert held_out(twice) == [False, True, False, True]


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


@pytest.mark.parametrize("free", [0, 1])
def test_machines_that_start_at_a_limit_are_learned_from_whole_recordings(tuning, free, monkeypatch):
    """Where only one unit moves before it meets a limit, no other one can be judged."""
    own, effort = replace(task(tuning), limits={"current": Limit(lower=-0.3, upper=0.3)}), EFFORTS["quick"]
    batch = recordings(own, effort).read_whole().on_time.batch
    until = np.where(np.array(batch.units) == batch.units[0], 1000 * free, 0)
    monkeypatch.setattr("kros.design.methods.predictor.before_limits", lambda *_: until)
    found, whole = Plan.of(own, effort, batch), Plan.of(own, effort, batch, whole=True)
    assert found.recipe == whole.recipe
    assert found.emphasis == whole.emphasis
    assert found.fill is not None


def test_units_that_none_can_judge_are_refused():
    past = SimpleNamespace(units=("a", "b"), conditions=("on at a limit",) * 2)
    with pytest.raises(DataError, match="no unit that is left out can be judged"):
        _held_out(past, {"on": np.ones(1)}, lambda _, rows: np.ones((len(rows), 1)))


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


def test_tuning_is_kept_where_nothing_speaks_against_it(tuning, made):
    own, product = made
    start, judge = product.observer, tuning.read()

    def changed(factor):
        A = np.concatenate([start.A[:1], factor * start.A[1:2], start.A[2:]])
        return replace(start, A=A, controller=replace(start.controller, D=A[:, :1]))

    worse, facts = tuned_where_better(own, judge, start, lambda seen, o: changed(0.5))
    assert worse is start
    assert not facts["tuned"]
    assert facts["held_out_percent"]["after"] > facts["held_out_percent"]["before"]
    rough = changed(0.5)
    better, facts = tuned_where_better(own, judge, rough, lambda seen, o: start)
    assert better is start
    assert facts["tuned"]
    alone = judge.part([0])
    assert tuned_where_better(own, alone, start, lambda seen, o: changed(0.5)) == (start, {"tuned": False})
    A = np.concatenate([1.5 * start.A[:1], start.A[1:]])  # what predicts the measurement matters where there is none
    lost = replace(start, A=A, controller=replace(start.controller, D=A[:, :1]))
    assert tuned_where_better(own, judge, start, lambda seen, o: lost)[0] is start
    assert relift_certificate(start, mismatch=False).certified


def test_what_is_tuned_is_judged_by_what_counts(tuning, made):
    observer, data = made[1].observer, tuning.read()
    keys = [replace(key, condition="cold" if i % 3 == 0 else "warm") for i, key in enumerate(data.batch.keys)]
    mixed = replace(data, batch=replace(data.batch, keys=tuple(keys)))
    (found,) = Plan(None, None, [2.0, 1.0], {"cold": (1.0, 1.0), "warm": (0.5, 0.0)}).score(mixed, [observer])
    error = observer.run(data.batch.states[..., :1], data.batch.inputs, data.parameters)[..., 1:3] - data.batch.states[..., 1:3]
    logs = np.log(np.sqrt(np.mean(error**2, axis=0)))
    cold, warm = (logs[[key.condition == c for key in keys]].mean(axis=0) for c in ("cold", "warm"))
    assert found == pytest.approx(100 * np.exp((cold @ [2.0, 1.0] + warm[0]) / 4.0))


def test_the_verdict_claims_no_set_for_it():
    entry = {"relift_certified": True, "worst_case_h2": None}
    metrics = {"study": {"units": 3, "conditions": ["noload"], "identify_on": "noload", "deployed": "koopman/memory"}}
    told = " ".join(
        verdict(metrics | {"observers": {"koopman/memory": entry}, "uncertainty": {"koopman": {"peak_db": {"x": 1.0}, "form": "x"}}})
    )
    assert "“Koopman, subspace predictor”" in told
    assert "not designed for a set of machines" in told
    assert "A certificate covers it as it runs" in told


def test_an_observer_that_loses_the_machine_is_not_made(made, monkeypatch):
    monkeypatch.setattr("kros.design.methods.predictor.DIVERGED", 0.0)
    product = design(made[0])
    assert product.synthesis is None
    assert "it diverges" in product.facts["reason"]
