"""A study tells what its observers do on disturbed measurements."""

from kros.evaluate import Kind


def test_every_disturbance_is_told_for_the_observers_of_the_kind_that_is_handed_over(metrics):
    rows = metrics["robustness"]
    kind = metrics["study"]["deployed"].rpartition("/")[0]
    observers = {r["observer"] for r in rows}
    made = {n for n, o in metrics["observers"].items() if o.get("status") != "failed" and n.startswith(f"{kind}/")}
    assert observers == made | {"filtered_difference", "learned"} | (
        {"koopman/ekf"} if "koopman/ekf" in metrics["observers"] else set()
    )
    assert {r["disturbance"] for r in rows} == {"none", *(k.value for k in Kind)}
    assert {r["condition"] for r in rows} == {metrics["study"]["identify_on"]}
    for row in rows:
        mean, worst = row["error_percent"]["mean"], row["error_percent"]["worst"]
        assert (mean is None) == (worst is None)
        assert mean is None or 0 < mean <= worst
    assert {r["channel"] for r in rows if r["observer"] == "filtered_difference"} == {"velocity"}
