"""Error of a diagnosis on the second recording of the same sensor."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.challenge.key import Key

if TYPE_CHECKING:
    from jaxtyping import Float


def ratio_to_oracle(corrected: Mapping[str, Float[Tensor, " N"]], key: Key) -> float:
    """Return the spread of the corrected field's length on inliers, relative to the oracle's residual.

    The scale of a calibrated field is free: the mean length of the inliers is set to the true length.

    Args:
        corrected: ``field_x``, ``field_y``, ``field_z`` of the second recording.
        key: key of the case, with its ``oracle_rms`` and the second recording's outliers.

    Returns:
        The ratio; infinite if the corrected field is not finite.
    """
    length = torch.stack([corrected[f"field_{axis}"].double() for axis in "xyz"], -1).norm(dim=-1)
    good = torch.ones(len(length), dtype=torch.bool)
    good[list(key.second_outliers)] = False
    rms = float((length[good] / length[good].mean()).std()) * key.field_strength
    return rms / key.oracle_rms if math.isfinite(rms) else math.inf
