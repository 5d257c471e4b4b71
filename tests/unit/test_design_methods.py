"""Which methods a study uses for which models, and which observer is deployed where several are as accurate."""

import logging

from kros.design.baselines import BASELINES
from kros.design.methods import METHODS, methods_of, suitable
from kros.observer import EstimatorSettings
from kros.report.names import LABELS
from kros.report.theme import Tone
from kros.study.config import study_schema


def names(wanted, kind):
    return [method.name for method in suitable(methods_of(wanted, EstimatorSettings()), kind)]


def test_the_choices_of_a_study_are_the_methods_and_the_baselines():
    parts = study_schema()["$defs"]
    methods = parts["SynthesisSettings"]["properties"]["methods"]["items"]["enum"]
    baselines = parts["ObserverSettings"]["properties"]["baselines"]["items"]["enum"]
    assert methods == ["paper", "mixed", "residual_h2", "worst_case_h2", "estimator"]
    assert baselines == ["open_loop", "kalman_tuned", *BASELINES]
    assert {*methods, *baselines} == {method.name for method in METHODS} | set(BASELINES)


def test_every_method_has_a_label():
    assert set(LABELS) == {method.name for method in METHODS} | set(BASELINES)
    assert len({label.text for label in LABELS.values()}) == len(LABELS)
    for label in LABELS.values():
        assert label.about
        assert label.tone in Tone.__members__


def test_what_does_not_suit_refined_models_is_left_out_with_the_reason(caplog):
    caplog.set_level(logging.INFO, logger="kros.design.methods")
    wanted = ("mixed", "paper", "worst_case_h2", "open_loop", "filtered_difference")
    assert names(wanted, "koopman_edmd") == ["open_loop", "paper", "mixed", "worst_case_h2"]
    assert not caplog.records
    assert names(wanted, "koopman") == ["open_loop", "worst_case_h2"]
    for method in ("mixed", "paper"):
        assert f"koopman/{method} is not designed: it is for the paper's models; set identify.refine" in caplog.text
