"""Simulations by name, for files that know no more than it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from mkc_torch.recording import Recording
from mkc_torch.simulation.magnetometer import MagnetometerCorrection
from mkc_torch.simulation.protocol import Correction

__all__ = ["correction_of"]


def correction_of(name: str, state: Mapping[str, Any], recording: Recording) -> Correction:
    """How a simulation corrects a recording.

    Raises:
        ValueError: no simulation of this name corrects recordings.
        MissingColumnError: the recording lacks a column.
    """
    if name != "magnetometer":
        raise ValueError(f'No simulation "{name}" is known that corrects recordings; known: magnetometer.')
    return MagnetometerCorrection(state, recording)
