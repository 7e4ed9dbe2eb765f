"""What stays in its place while the contact turns holds a fit back: dirt, coarse compression."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

HELD_MAX = 3.0
"""A pattern that stays put and is this much stronger than the contact is not told from any stronger one."""
TELLING = 1e-3
"""A reference that a turn changes by less of its square than this cannot tell what has stayed."""

Field = NDArray[np.float32]


def static_pattern_bias(motion: Field, weight: Field, difference: Field, unmoved: Field) -> float:
    """The turn that a fit lacks, as a share of the turn it has found, by what has stayed in its place; 0 to `HELD_MAX`.

    Of a picture with a share a of a pattern that stays and 1 - a of one that turns, a fit of small turns finds 1 - a
    of the turn; what it leaves is a / (1 - a) of the unmoved reference, but for what turn, shift, scale and gain
    explain. That is sought by least squares.

    motion: (N, 5), change of the reference per motion. weight, difference: (N,), of the fit and what it leaves.
    unmoved: (N,), the reference's own picture where its points have moved to.
    """
    weighted = motion.T * weight
    normal = (weighted @ motion).astype(np.float64)
    normal += 1e-9 * (float(np.trace(normal)) + 1e-9) * np.eye(len(normal))
    explained = np.linalg.solve(normal, (weighted @ unmoved).astype(np.float64)).astype(np.float32)
    stays = unmoved - motion @ explained
    weighed = weight * stays
    told = float(weighed @ stays) + TELLING * float(weight @ unmoved**2) + 1e-9
    return min(max(float(weighed @ difference) / told, 0.0), HELD_MAX)
