"""The table of forms, word by word, with pseudo-inverses of NumPy; matrices or stacks of them."""

import numpy as np

from kros.uncertainty import Form


def residual_of(form, G, Gp):
    """The residual of a plant around a nominal."""
    pinv = np.linalg.pinv
    return {
        Form.ADDITIVE: lambda: Gp - G,
        Form.INPUT_MULTIPLICATIVE: lambda: pinv(G) @ (Gp - G),
        Form.OUTPUT_MULTIPLICATIVE: lambda: (Gp - G) @ pinv(G),
        Form.INVERSE_ADDITIVE: lambda: pinv(Gp) @ (Gp - G) @ pinv(G),
        Form.INVERSE_INPUT_MULTIPLICATIVE: lambda: pinv(Gp) @ (Gp - G),
        Form.INVERSE_OUTPUT_MULTIPLICATIVE: lambda: (Gp - G) @ pinv(Gp),
    }[Form(form)]()


def plant_of(form, G, E):
    """The plant that a residual makes of a nominal."""
    inv, eye = np.linalg.inv, np.eye(E.shape[-2])
    return {
        Form.ADDITIVE: lambda: G + E,
        Form.INPUT_MULTIPLICATIVE: lambda: G @ (eye + E),
        Form.OUTPUT_MULTIPLICATIVE: lambda: (eye + E) @ G,
        Form.INVERSE_ADDITIVE: lambda: G @ inv(eye - E @ G),
        Form.INVERSE_INPUT_MULTIPLICATIVE: lambda: G @ inv(eye - E),
        Form.INVERSE_OUTPUT_MULTIPLICATIVE: lambda: inv(eye - E) @ G,
    }[Form(form)]()
