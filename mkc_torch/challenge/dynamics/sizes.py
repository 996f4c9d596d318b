"""Draw the size of a hidden effect by z_sep or z, below an obvious size."""

from __future__ import annotations

import math

import numpy as np
from torch import Generator

from mkc_torch.challenge.draws import happens, log_uniform
from mkc_torch.challenge.dynamics.errors import Whitening
from mkc_torch.challenge.dynamics.integrate import outputs_of_sizes
from mkc_torch.challenge.dynamics.oracle import Judge, tangents
from mkc_torch.challenge.dynamics.plant import HiddenTerm
from mkc_torch.challenge.dynamics.scene import SystemScene

STRONG_SHARE = 0.7
"""Share of the effects of the catalogue whose size is drawn by z_sep; the others are drawn by z."""

STRONG_Z_SEP = (12.0, 70.0)
FREE_Z = (3.0, 60.0)
OUTSIDE_Z = (10.0, 60.0)
MOST_Z = 250.0

_TRIED = 12
_LEAST = 1e-3
"""Smallest size that is tried, as a share of the obvious size."""


def draw_size(g: Generator, hidden: HiddenTerm, scene: SystemScene, errors: Whitening, *, outside: bool) -> float:
    """Draw a size below ``hidden.large``.

    Args:
        hidden: the effect.
        scene: the runs without hidden effects.
        errors: noise of the outputs.
        outside: whether the effect is outside the catalogue and has no rivals.
    """
    strong = not outside and happens(g, STRONG_SHARE)
    wanted = log_uniform(g, *(OUTSIDE_Z if outside else STRONG_Z_SEP if strong else FREE_Z))
    judge = Judge(tangents(scene, errors, rivals=strong))
    sizes = hidden.large * np.geomspace(_LEAST, 1.0, _TRIED)
    before = 0.0
    for k, there in enumerate(outputs_of_sizes(scene.plant, scene.trial, hidden, sizes)):
        seen = judge.power(errors.whitened(there - scene.course.outputs), hidden)
        # ratio to the limits; 1 is at a limit
        share = max(seen.z / MOST_Z, (seen.z_sep if strong else seen.z) / wanted)
        if share >= 1.0:
            between = math.log(before) / math.log(before / share) if before > 0.0 else 1.0
            return float(sizes[max(k - 1, 0)] ** (1.0 - between) * sizes[k] ** between)
        before = share
    return hidden.large
