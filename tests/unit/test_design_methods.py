"""Which methods a study uses for which models, and which observer is deployed where several are as accurate."""

import logging

from kros.design.methods import METHODS, methods_of, preferred, suitable
from kros.design.settings import BASELINES
from kros.design.settings import METHODS as NAMES


def names(wanted, kind):
    return [method.name for method in suitable(methods_of(wanted), kind)]


def test_every_name_of_a_study_has_a_method():
    known = {method.name for method in METHODS}
    assert set(NAMES.__args__) < known
    assert known - set(NAMES.__args__) == {"open_loop", "kalman_tuned"} <= set(BASELINES.__args__)


def test_what_does_not_suit_refined_models_is_left_out_with_the_reason(caplog):
    caplog.set_level(logging.INFO, logger="kros.design.methods")
    wanted = ("mixed", "paper", "worst_case_h2", "open_loop", "filtered_difference")
    assert names(wanted, "koopman_edmd") == ["open_loop", "paper", "mixed", "worst_case_h2"]
    assert not caplog.records
    assert names(wanted, "koopman") == ["open_loop", "worst_case_h2"]
    for method in ("mixed", "paper"):
        assert f"koopman/{method} is not designed: it is for the paper's models; set identify.refine" in caplog.text


def test_the_best_guarantee_is_deployed():
    made = ["koopman/open_loop", "koopman/residual_h2", "koopman/worst_case_h2", "linear/worst_case_h2"]
    assert preferred(made) == "koopman/worst_case_h2"
    assert preferred(["koopman/ekf"]) is None
