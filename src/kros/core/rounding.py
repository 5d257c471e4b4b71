"""What counts as rounding, the one place for tolerances of this kind."""

import numpy as np

EPS = float(np.finfo(float).eps)
TINY = float(np.finfo(float).tiny)  # the least positive number: keeps divisions and logarithms finite
ROUNDING = 1e-12  # relative, of sums of products
ITERATED = 1e-9  # relative, of what iterations and factorisations return
AGREED = 1e-6  # relative, of what two algorithms return for one number
SINGULAR = 0.01 / EPS  # condition of a matrix that rounding makes singular
