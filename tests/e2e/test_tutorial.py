"""The tutorial as a reader follows it: its Python and its commands, in order, in an empty folder."""

from __future__ import annotations

import csv
import re
import shlex
import shutil
import subprocess
from pathlib import Path

PAGE = Path(__file__).parents[2] / "docs" / "tutorial.md"
# the study of the page takes a minute; what it does is the same
QUICKER = ["identify.refine=false", 'synthesis.methods=["worst_case_h2"]', 'observer.baselines=["open_loop"]']
QUICKER += ["estimator.rows=4000", "estimator.folds=2", "estimator.gap_samples=20000", "uncertainty.n_freqs=60"]


def steps() -> list[tuple[str, str]]:
    """Blocks of Python and lines of the console behind the installation, in order."""
    followed = PAGE.read_text(encoding="utf-8").split("## 2. ")[1]
    found: list[tuple[str, str]] = []
    for language, block in re.findall(r"^```(python|console)\n(.*?)^```$", followed, flags=re.MULTILINE | re.DOTALL):
        lines = [block] if language == "python" else [line.removeprefix("$ ") for line in block.splitlines()]
        found += [(language, line) for line in lines]
    return found


def test_the_tutorial_from_csv_to_a_board(kros, few_figures, low_order_weights, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    done = []
    for language, text in steps():
        if language == "python":
            exec(compile(text, str(PAGE), "exec"), {})
            continue
        name, *arguments = shlex.split(text)
        if name == "kros":
            quicker = [part for setting in QUICKER for part in ("--set", setting)] if arguments[0] == "run" else []
            result = kros(*arguments, *quicker)
            expected = 4 if arguments[0] == "check" else 0  # four machines cannot tell what is usual
            assert result.exit_code == expected, f"{text}: {result.output}"
        elif shutil.which(name):
            ran = subprocess.run([name, *arguments], capture_output=True, text=True, check=False)
            assert ran.returncode == 0, f"{text}: {ran.stdout}{ran.stderr}"
        done.append(" ".join([name, *arguments][:2]))
    assert done[:6] == ["kros init", "kros run", "kros list", "kros estimate", "kros check", "kros export"]
    with Path("estimates.csv").open(newline="") as file:
        names = next(csv.reader(file))
    assert names[:6] == ["unit", "condition", "episode", "k", "time_s", "status"]
    assert [name for name in names if "_hat" in name] == [
        "position_hat [rad]",
        "velocity_hat [rad/s]",
        "current_hat [A]",
    ]
    for path in ("runs/study/report.html", "axis/axis.c", "axis/axis.h", "axis/README.md", "axis/example_main.c"):
        assert Path(path).is_file()
    called = set(re.findall(r"\baxis_\w+(?=\()", PAGE.read_text(encoding="utf-8")))
    assert called == set(re.findall(r"\baxis_\w+(?=\()", Path("axis/axis.h").read_text())) & called != set()
