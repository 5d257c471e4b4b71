r"""What the weights of a study leave out, for the certificate: pseudo-inverse residuals do not rebuild every unit exactly.

The uncertainty stage adds an additive remainder to the set where the misfit exceeds one per cent of a unit's response. Below that it is small
beside the response, but not beside the *error*, which is a difference of responses: where all units agree it can be larger than all that the
weights allow. The certificate therefore always contains it.

With ``l_i = sqrt(n) max_k |row i of R_k|`` over units k, ``||diag(l)^-1 R_k||_F <= 1``: a sound cover, one filter for every state.
"""

from __future__ import annotations

import numpy as np

from ..core.lti import StateSpace, block_diagonal, gain
from ..identify import ModelSet
from ..uncertainty import UncertainModel, fit_magnitude
from ..uncertainty.residuals import completion
from .responses import scaled_responses

_EXACT = 1e-12  # of the largest response


def leftover(models: ModelSet, unit: str, uncertain: UncertainModel) -> tuple[StateSpace, StateSpace] | None:
    """Return left and right weights of the additive remainder of the units that are covered; None where there is none, or one already."""
    if uncertain.remainder is not None:
        return None
    responses = scaled_responses(models, list(uncertain.unit_ids), uncertain.freqs_hz)
    nominal = scaled_responses(models, [unit], uncertain.freqs_hz)[0]
    _, R = completion(uncertain.form, nominal, responses)
    rows = np.sqrt(R.shape[-2]) * np.linalg.norm(R, axis=-1).max(axis=0)
    least = _EXACT * float(np.abs(responses).max())
    if rows.max() <= least:
        return None
    dt = models.sample_period_s
    filters = [
        fit_magnitude(uncertain.freqs_hz, np.maximum(row, max(least, 1e-6 * row.max())), dt, max_order=2, tolerance_db=6.0).system
        for row in rows.T
    ]
    return block_diagonal(filters), gain(np.eye(R.shape[-1]), dt)
