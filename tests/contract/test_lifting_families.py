"""One suite over all families: C computes what NumPy does, derivatives are finite differences, bounds hold every
sample."""

import shutil
import subprocess

import numpy as np
import pytest
from families import FAMILIES, INPUT_FUNCTIONS, INPUTS, STATES

from kros.core.errors import ConfigError
from kros.lifting import Lifting, radial
from kros.lifting.program import Precision, c_code

BOX = {"position": (-1.5, 1.2), "velocity": (0.1, 2.0), "voltage": (-3.0, 3.0)}
PHASE = (0.2, 0.9)


@pytest.fixture(params=FAMILIES, name="lifting")
def _lifting(request):
    return Lifting(STATES, FAMILIES[request.param], ("phase",), INPUTS, INPUT_FUNCTIONS)


def samples(lifting, n, seed=0):
    """Random windows, inputs and phases within the box, its corners among them."""
    rng = np.random.default_rng(seed)
    ends = np.array([BOX[name.partition("[")[0]] for name in (*lifting.window.names, *INPUTS)] + [PHASE])
    share = rng.uniform(size=(n, len(ends)))
    share[: n // 4] = rng.integers(0, 2, size=(n // 4, len(ends)))
    drawn = np.clip(ends[:, 0] + share * (ends[:, 1] - ends[:, 0]), *ends.T)  # rounding may lead out of the box
    return drawn[:, :-2], drawn[:, -2:-1], drawn[:, -1]


def test_c_computes_what_numpy_does(lifting, tmp_path):
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        pytest.skip("no C compiler on this machine")
    windows, u, phase = samples(lifting, 60)
    depth = lifting.history
    lines = []
    pointers = dict(lifting.window.depths)
    for name in (*STATES, *INPUTS):
        slot = f"row[{lifting.window.names.index(name) if name in STATES else windows.shape[1]}]"
        if name in pointers:
            earlier = [f"row[{lifting.window.names.index(f'{name}[-{d}]')}]" for d in range(pointers[name], 0, -1)]
            values = ",".join([*earlier, slot])
            lines.append(f"const double {name}_all[]={{{values}}};")
            lines.append(f"const double *{name}={name}_all+{pointers[name]};(void){name};")
        else:
            lines.append(f"const double {name}={slot};(void){name};")
    expressions = [formula.expression for formula in lifting.formulas + lifting.input_formulas]
    written = [
        c_code(tree, lambda name: f"{name}[0]" if name in pointers else name, Precision()) for tree in expressions
    ]
    lines += [f'printf("%.17g\\n",(double)({expression}));' for expression in written]
    width = windows.shape[1] + 2
    source = (
        "#include <math.h>\n#include <stdio.h>\n"
        f"int main(void){{double row[{width}];for(;;){{for(int i=0;i<{width};i++)"
        f'if(scanf("%lf",row+i)!=1)return 0;const double phase=row[{width - 1}];(void)phase;{"".join(lines)}}}}}\n'
    )
    (tmp_path / "f.c").write_text(source)
    flags = ["-std=c99", "-Wall", "-Wextra", "-Werror"]
    subprocess.run([compiler, *flags, str(tmp_path / "f.c"), "-o", str(tmp_path / "f"), "-lm"], check=True)
    rows = np.column_stack([windows, u, phase])
    text = "\n".join(" ".join(f"{v:.17g}" for v in row) for row in rows)
    out = subprocess.run([str(tmp_path / "f")], input=text, check=True, capture_output=True, text=True).stdout
    found = np.array(out.split(), dtype=float).reshape(60, -1)
    p = len(lifting.functions)
    np.testing.assert_allclose(found[:, :p], lifting.lift(windows, {"phase": phase})[:, 2:], rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(
        found[:, p:], lifting.lift_inputs(u, windows, {"phase": phase})[:, 1:], rtol=1e-12, atol=1e-12
    )
    assert depth == max(pointers.values())


def test_derivatives_are_finite_differences(lifting):
    windows, _, phase = samples(lifting, 40)
    windows = windows[10:]  # corners apart: a sign may jump there
    phase = phase[10:]
    slopes = lifting.slopes(windows, {"phase": phase})
    step = 1e-6
    for j in range(windows.shape[1]):
        moved = step * np.eye(windows.shape[1])[j]
        slope = (lifting.lift(windows + moved, {"phase": phase}) - lifting.lift(windows - moved, {"phase": phase}))[
            :, 2:
        ] / (2 * step)
        scale = np.maximum(np.abs(lifting.lift(windows, {"phase": phase})[:, 2:]), 1)
        # rounding of the difference: eps/step in units of the value; curvature: the fifth harmonic has third
        # derivatives of 500**3
        tolerance = 1e-9 * scale + 1e-6 * np.abs(slopes[..., j]) + 5e-5
        assert np.all(np.abs(slope - slopes[..., j]) <= tolerance)


def test_a_family_that_does_not_separate_says_so():
    with pytest.raises(ConfigError, match="must enter as factors or as phases"):
        _ = Lifting(("position",), radial(["position + phase"], [[0.0]], 1.0), ("phase",)).separation
