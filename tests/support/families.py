"""A lifting of every family, of two states and an input."""

import numpy as np

from kros.lifting import delays, harmonics, polynomials, radial

STATES, INPUTS = ("position", "velocity"), ("voltage",)
CENTRES = np.random.default_rng(0).uniform(-2, 2, (5, 2))
FAMILIES = {
    "harmonics": harmonics("position", 100, [1, 2, 5], "phase"),
    "polynomials": polynomials(STATES, 4),
    "gaussian": radial(STATES, CENTRES, [0.3, 1.7]),
    "delays": delays((*STATES, *INPUTS), 3),
    "free": (
        "tanh(velocity/0.05)*phase",
        "abs(velocity)*velocity - sign(position[-2])/3",
        "atan(position)*sqrt(1 + velocity[-1]**2)",
        "log(2 + sin(position)) + tan(position/4)",
        "exp(-position**2)*velocity**-2",
        "12345678901234*position/98765432109876 + 10000000000000000000000*velocity",
    ),
    "of functions": polynomials(["sin(3*position)", "velocity[-1]"], 3),
}
FAMILIES["all"] = tuple(text for functions in FAMILIES.values() for text in functions)
INPUT_FUNCTIONS = ("position*voltage", "(velocity[-1])*voltage")
