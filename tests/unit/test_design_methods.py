"""Which methods a study makes for which models, what starts first, and what is deployed."""

import logging

from kros.design.methods.design import DESIGNS
from kros.design.methods.table import METHODS, preferred, slowest_first, suitable

BOTH = ("linear", "linear_edmd")


def test_every_method_has_a_design():
    assert {method.name for method in METHODS} == set(DESIGNS)
    assert len({method.rank for method in METHODS}) == len(METHODS)


def test_what_does_not_suit_refined_models_is_left_out_with_the_reason(caplog):
    caplog.set_level(logging.INFO, logger="kros.design.methods.table")
    wanted = ("mixed", "worst_case_h2", "open_loop", "filtered_difference")
    assert [m.name for m in suitable(wanted, "koopman_edmd", ("koopman_edmd",))] == [
        "open_loop",
        "mixed",
        "worst_case_h2",
    ]
    assert not caplog.records
    assert [m.name for m in suitable(wanted, "koopman", ("koopman",))] == ["open_loop", "worst_case_h2"]
    assert "koopman/mixed is not made for refined models" in caplog.text
    assert [m.name for m in suitable(("residual_h2", "estimator"), "linear", BOTH)] == [
        "residual_h2",
        "estimator",
    ]
    assert [m.name for m in suitable(("residual_h2", "estimator"), "linear_edmd", BOTH)] == ["residual_h2"]
    alone = suitable(("residual_h2", "estimator"), "linear_edmd", ("linear_edmd",))
    assert [m.name for m in alone] == ["residual_h2", "estimator"]
    assert "linear_edmd/estimator is made for refined models alone: it is fitted to recordings" in caplog.text


def test_the_slowest_start_first_and_the_best_guarantee_is_deployed():
    assert slowest_first(["open_loop", "worst_case_h2", "residual_h2", "kalman_tuned"]) == [1, 2, 3, 0]
    made = ["koopman/open_loop", "koopman/residual_h2", "koopman_edmd/worst_case_h2", "linear/worst_case_h2"]
    assert preferred(made) == "koopman_edmd/worst_case_h2"
    assert preferred(["koopman/ekf"]) is None
