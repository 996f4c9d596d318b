"""How large a hidden effect is drawn: by z_sep or by z, but never so large that nobody could miss it."""

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
"""Share of the effects of the catalogue whose size is drawn by z_sep; that of the others by z."""

STRONG_Z_SEP = (12.0, 70.0)
FREE_Z = (3.0, 60.0)
OUTSIDE_Z = (10.0, 60.0)
MOST_Z = 250.0

_TRIED = 12
_LEAST = 1e-3
"""Smallest size that is tried, as a share of the large one."""


def draw_size(g: Generator, hidden: HiddenTerm, scene: SystemScene, errors: Whitening, *, outside: bool) -> float:
    """A size between a trifle and ``hidden.large``.

    Args:
        hidden: the effect.
        scene: the runs with nothing hidden.
        errors: of the outputs.
        outside: the effect is none of the catalogue's, and has no rivals to be told from.
    """
    strong = not outside and happens(g, STRONG_SHARE)
    wanted = log_uniform(g, *(OUTSIDE_Z if outside else STRONG_Z_SEP if strong else FREE_Z))
    judge = Judge(tangents(scene, errors, rivals=strong))
    sizes = hidden.large * np.geomspace(_LEAST, 1.0, _TRIED)
    before = 0.0
    for k, there in enumerate(outputs_of_sizes(scene.plant, scene.trial, hidden, sizes)):
        seen = judge.power(errors.whitened(there - scene.course.outputs), hidden)
        # how near it is to the one limit or the other; 1 is there
        share = max(seen.z / MOST_Z, (seen.z_sep if strong else seen.z) / wanted)
        if share >= 1.0:
            between = math.log(before) / math.log(before / share) if before > 0.0 else 1.0
            return float(sizes[max(k - 1, 0)] ** (1.0 - between) * sizes[k] ** between)
        before = share
    return hidden.large
