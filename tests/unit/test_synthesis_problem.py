"""The observer problem of an uncertain model: nothing is lost, and what does not belong together is refused."""

from dataclasses import replace

import numpy as np
import pytest
from random_models import random_models

from kros.core.errors import SynthesisError
from kros.identify import ModelSet
from kros.synthesis import Injection, ObserverProblem
from kros.uncertainty import quantify


@pytest.fixture(scope="module")
def models() -> ModelSet:
    scale = np.array([1.0, 2.0, 0.5])
    return random_models([[0.1], [1.0], [0.3]], 0.003, "sin(0.5*position)", 4, output_scale=scale)


@pytest.fixture(scope="module")
def uncertain(models):
    return quantify(models, form="inverse_input_multiplicative", freqs_hz=models.frequencies(60), max_order=2)


def test_nothing_is_left_out(models, uncertain):
    case = ObserverProblem.from_uncertain(models, uncertain, [1e-3])
    assert uncertain.remainder is not None
    assert case.remainder_left is uncertain.remainder.left
    assert case.remainder_right is uncertain.remainder.right
    assert (case.W_L, case.W_R, case.form) == (uncertain.weight.left, uncertain.weight.right, uncertain.form)
    assert np.array_equal(case.nominal.A, models.A[uncertain.nominal])
    assert np.array_equal(case.C, [[1.0, 0.0, 0.0]])
    assert (case.n_original, case.injection) == (2, Injection.STATE)
    assert np.array_equal(case.output_scale, models.output_scale)


def test_models_of_another_population_are_refused(models, uncertain):
    with pytest.raises(SynthesisError, match="not the nominal that the uncertain set surrounds"):
        ObserverProblem.from_uncertain(replace(models, A=0.9 * models.A), uncertain, [1e-3])


def test_a_nominal_that_is_no_unit_is_refused(models, uncertain):
    with pytest.raises(SynthesisError, match="'pooled' is none of the models' units"):
        ObserverProblem.from_uncertain(models, replace(uncertain, nominal_id="pooled"), [1e-3])
