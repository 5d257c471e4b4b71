"""The page of benchmarks is made from what pytest-benchmark measured: ratios over kros, divided by shares, and exponents."""

import benchmarks_page


def measured(group, median, **info):
    return {"group": group, "stats": {"median": median}, "extra_info": info}


def test_ratios_and_exponents():
    size = {"size": "3 units", "deviation": float("nan"), "note": ""}
    stages = [measured("identify", 1.0, by="kros", share=1.0, **size), measured("identify", 0.25, by="other", share=0.5, **size)]
    curve = [measured("c", n**1.5, curve="fit", against="units", size=n) for n in (1, 2, 4)]
    machine = {
        "cpu": {"brand_raw": "a processor", "count": 2},
        "machine": "x",
        "system": "s",
        "python_implementation": "P",
        "python_version": "3",
    }
    page = benchmarks_page.render({"machine_info": machine, "datetime": "2026-01-02T03", "benchmarks": stages + curve}, {"kros": "1.0"})
    assert "| other | 500 ms | 0.50 | not compared | given 0.5 of the problem |" in page
    assert page.split("| fit |")[1].splitlines()[0].endswith("| 1.50 |")
    assert all(fact in page for fact in ("2026-01-02", "a processor, 2 cores", "kros 1.0"))
