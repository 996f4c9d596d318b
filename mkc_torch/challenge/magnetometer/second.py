"""How well a diagnosis corrects the same sensor's second recording."""

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
    """Spread of the corrected field's length on good samples, relative to what the oracle leaves.

    The scale of a calibrated field is the user's choice: the mean length of the good samples is set to the true one.

    Args:
        corrected: ``field_x``, ``field_y``, ``field_z`` of the second recording.
        key: of the case, with its ``oracle_rms`` and the second recording's outliers.

    Returns:
        The ratio; infinite where the corrected field is not finite.
    """
    length = torch.stack([corrected[f"field_{axis}"].double() for axis in "xyz"], -1).norm(dim=-1)
    good = torch.ones(len(length), dtype=torch.bool)
    good[list(key.second_outliers)] = False
    rms = float((length[good] / length[good].mean()).std()) * key.field_strength
    return rms / key.oracle_rms if math.isfinite(rms) else math.inf
