"""Differential equations whose sensors have an offset of their own in each recording."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from mkc_torch.nonlinear import load_forward_mode
from mkc_torch.simulation.dynamics.equations import Equations
from mkc_torch.simulation.dynamics.prepared import PreparedDynamics
from mkc_torch.simulation.own_offsets import OwnOffset, determined_offsets
from mkc_torch.simulation.parameter import Parameter

if TYPE_CHECKING:
    from jaxtyping import Int

__all__ = ["with_own_offsets"]


class _Offset:
    """A system with offsets of outputs among its parameters, behind its own; all else is the system's.

    Args:
        system: whose sensors have the offsets.
        own_offsets: which.
        of_run: number of the recording that each run is of.
    """

    def __init__(self, system: Equations, own_offsets: tuple[OwnOffset, ...], of_run: Int[Tensor, " K"]) -> None:
        self.system, self.own_offsets, self.of_run = system, own_offsets, of_run
        self.parameters: Mapping[str, float | Parameter] = {
            **system.parameters,
            **{one.name: Parameter(0.0, unit=system.units.get(one.output, "")) for one in own_offsets},
        }

    def __getattr__(self, name: str) -> Any:
        if name == "system" or name.startswith("__"):  # a copy has nothing yet
            raise AttributeError(name)
        return getattr(self.system, name)

    def sensor(self, time: Tensor, y: Mapping[str, Tensor], p: Any, run: Tensor) -> Mapping[str, Tensor]:
        """What the system's sensors make of the outputs, and the offset of each recording."""
        shown = dict(self.system.sensor(time, y, p, run))
        recording = self.of_run[run]
        for one in self.own_offsets:
            there = (recording == one.recording).to(time.dtype)
            shown[one.output] = shown[one.output] + getattr(p, one.name) * there
        return shown


def with_own_offsets(
    prepared: PreparedDynamics, recording: Int[Tensor, " N"], names: Sequence[str]
) -> PreparedDynamics:
    """The same with an offset of each output in each recording, as far as they are determined.

    Args:
        prepared: the simulation of several recordings.
        recording: number of the recording that each sample is of.
        names: of the recordings.
    """
    load_forward_mode()
    theta = prepared.start()
    near = prepared.trajectory(theta, {})
    tangents = torch.func.jacfwd(lambda values: prepared.residual(values, {}, near))(theta)
    if not bool(tangents.isfinite().all()):
        return prepared
    found = determined_offsets(tangents, prepared.channels, recording, names)
    if not found:
        return prepared
    of_run = recording.new_zeros(int(prepared.run.max()) + 1).scatter(0, prepared.run, recording)
    system: Any = _Offset(prepared.system, found, of_run)
    return PreparedDynamics(system, prepared.recording, prepared.channels)
