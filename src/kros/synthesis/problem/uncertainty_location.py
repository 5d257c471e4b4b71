r"""Where the perturbation acts, what it sees, and whether it sees its own effect: six forms.

With ``E = W_L Delta W_R`` on scaled signals, ``G`` the nominal model from input to state and ``w2 = Delta z2``,

::

                        +-------------- inverse ---------------+
                        v                                      |
     u' ------+------->(+)--> W_R --> z2 --> Delta --> w2 --> W_L --+--> at the input:  x = G (u' + W_L w2)
              |         ^                                           |
              +--> G ---+   (sees the state)                        +--> at the state:  x = G u' + W_L w2

=============================  =========  ========  =======  =====  ===============  ===========  =====================
form                           acts at    sees      inverse  T_e    M                N            robust when
=============================  =========  ========  =======  =====  ===============  ===========  =====================
additive                       state      input     no       S      W_R W_u          0            always
input multiplicative           input      input     no       S G    W_R W_u          0            always
output multiplicative          state      state     no       S      W_R G W_u        0            always
inverse additive               input      state     yes      S G    W_R G W_u        W_R G W_L    ``||N|| < 1``
inverse input multiplicative   input      input     yes      S G    W_R W_u          W_R W_L      ``||N|| < 1``
inverse output multiplicative  state      state     yes      S      W_R G W_u        W_R W_L      ``||N|| < 1``
=============================  =========  ========  =======  =====  ===============  ===========  =====================

In all of them the error is ``e = T_e W_L X M w1`` with ``X = Delta (I - N Delta)^-1``, and the observer is in ``T_e``
alone: K is outside the loop of Delta.

Symbols
-------
S : error sensitivity;  M : from the disturbance to z2;  N : from w2 to z2
"""

from __future__ import annotations

from dataclasses import dataclass

from ...core.lti import StateSpace
from ...uncertainty.forms import Form


@dataclass(frozen=True)
class UncertaintyLocation:
    """Where a perturbation acts, and what it sees."""

    at_input: bool  # It acts on the plant's input, otherwise on its state
    sees_input: bool  # It sees the input, otherwise the state
    inverse: bool  # It sees its own effect too

    @property
    def N_name(self) -> str:  # noqa: N802
        """What N is made of."""
        if not self.inverse:
            return "0"
        return "W_R W_L" if self.at_input is self.sees_input else "W_R G W_L"

    def sizes(self, n: int, m: int) -> tuple[int, int]:
        """Rows of W_L and columns of W_R, for n states and m inputs."""
        return (m if self.at_input else n), (m if self.sees_input else n)

    def M(self, W_R: StateSpace, G: StateSpace, W_u: StateSpace) -> StateSpace:  # noqa: N802
        """From the disturbance to what Delta sees: M."""
        return W_R @ W_u if self.sees_input else W_R @ (G @ W_u)

    def N(self, W_R: StateSpace, G: StateSpace, W_L: StateSpace) -> StateSpace | None:  # noqa: N802
        """From what Delta does to what it sees: N; None where there is no loop."""
        if not self.inverse:
            return None
        return W_R @ W_L if self.at_input is self.sees_input else W_R @ (G @ W_L)


LOCATIONS = {
    Form.ADDITIVE: UncertaintyLocation(at_input=False, sees_input=True, inverse=False),
    Form.INPUT_MULTIPLICATIVE: UncertaintyLocation(at_input=True, sees_input=True, inverse=False),
    Form.OUTPUT_MULTIPLICATIVE: UncertaintyLocation(at_input=False, sees_input=False, inverse=False),
    Form.INVERSE_ADDITIVE: UncertaintyLocation(at_input=True, sees_input=False, inverse=True),
    Form.INVERSE_INPUT_MULTIPLICATIVE: UncertaintyLocation(at_input=True, sees_input=True, inverse=True),
    Form.INVERSE_OUTPUT_MULTIPLICATIVE: UncertaintyLocation(at_input=False, sees_input=False, inverse=True),
}
