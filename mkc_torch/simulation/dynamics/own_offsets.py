"""Differential equations with a sensor offset for each recording."""

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
    """A system with output offsets as further parameters after its own; everything else is delegated to the system.

    Args:
        system: the equations.
        own_offsets: the offsets.
        of_run: (K,), index of the recording of each run.
    """

    def __init__(self, system: Equations, own_offsets: tuple[OwnOffset, ...], of_run: Int[Tensor, " K"]) -> None:
        self.system, self.own_offsets, self.of_run = system, own_offsets, of_run
        self.parameters: Mapping[str, float | Parameter] = {
            **system.parameters,
            **{offset.name: Parameter(0.0, unit=system.units.get(offset.output, "")) for offset in own_offsets},
        }

    def __getattr__(self, name: str) -> Any:
        if name == "system" or name.startswith("__"):  # copies are looked up before `system` is set
            raise AttributeError(name)
        return getattr(self.system, name)

    def sensor(self, time: Tensor, y: Mapping[str, Tensor], p: Any, run: Tensor) -> Mapping[str, Tensor]:
        """Return the outputs of the system's sensors plus the offset of each recording."""
        shown = dict(self.system.sensor(time, y, p, run))
        recording = self.of_run[run]
        for offset in self.own_offsets:
            there = (recording == offset.recording).to(time.dtype)
            shown[offset.output] = shown[offset.output] + getattr(p, offset.name) * there
        return shown


def with_own_offsets(
    prepared: PreparedDynamics, recording: Int[Tensor, " N"], names: Sequence[str]
) -> PreparedDynamics:
    """Add an offset of each output in each recording, as far as the recordings determine it.

    Args:
        prepared: the simulation of several recordings.
        recording: (N,), index of the recording of each sample.
        names: names of the recordings.
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
