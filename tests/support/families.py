"""A lifting of every family, of two states and an input."""

from kros.lifting import (
    concatenate,
    delays,
    formulas,
    fourier_features,
    harmonics,
    latin_hypercube_centres,
    polynomials,
    products,
    radial,
)

STATES, INPUTS = ("position", "velocity"), ("voltage",)
CENTRES = latin_hypercube_centres([[-2, 2], [-2, 2]], 5, 0)
FAMILIES = {
    "harmonics": harmonics("position", 100, [1, 2, 5], "phase"),
    "polynomials": polynomials(STATES, 4),
    "gaussian": radial(STATES, CENTRES, [0.3, 1.7]),
    "multiquadric": radial(STATES, CENTRES, 0.9, "multiquadric"),
    "inverse multiquadric": radial(STATES, CENTRES, 0.9, "inverse_multiquadric"),
    "thin plate": radial(STATES, CENTRES, 0.9, "thin_plate"),
    "fourier": fourier_features(STATES, 6, 0.8, 1),
    "laplacian": fourier_features(STATES, 6, 0.8, 1, "laplacian"),
    "delays": delays((*STATES, *INPUTS), 3),
    "free": formulas(
        [
            "tanh(velocity/0.05)*phase",
            "abs(velocity)*velocity - sign(position[-2])/3",
            "atan(position)*sqrt(1 + velocity[-1]**2)",
            "log(2 + sin(position)) + tan(position/4)",
            "exp(-position**2)*velocity**-2",
            "12345678901234*position/98765432109876 + 10000000000000000000000*velocity",
        ]
    ),
    "of functions": polynomials(["sin(3*position)", "velocity[-1]"], 3),
}
FAMILIES["all"] = concatenate(*FAMILIES.values())
INPUT_FUNCTIONS = products(["position", "velocity[-1]"], ["voltage"])
