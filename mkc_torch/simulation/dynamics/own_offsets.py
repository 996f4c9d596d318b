"""Differential equations with a sensor offset for each recording."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from torch import Tensor

from mkc_torch.simulation.dynamics.equations import Equations
from mkc_torch.simulation.own_offsets import OwnOffset, determined_offsets
from mkc_torch.simulation.parameter import Parameter

if TYPE_CHECKING:
    from jaxtyping import Float, Int


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


def equations_with_offsets(
    system: Equations,
    outputs: Sequence[str],
    run: Int[Tensor, " N"],
    tangents: Float[Tensor, "N m p"],
    recording: Int[Tensor, " N"],
    names: Sequence[str],
) -> Equations | None:
    """Add an offset of each output in each recording; None where the recordings determine no offset.

    Args:
        system: the equations.
        outputs: names of the m compared outputs.
        run: number of the run of each sample.
        tangents: derivatives of the residual by the parameters.
        recording: index of the recording of each sample.
        names: names of the recordings.
    """
    if not bool(tangents.isfinite().all()):
        return None
    found = determined_offsets(tangents, outputs, recording, names)
    if not found:
        return None
    of_run = recording.new_zeros(int(run.max()) + 1).scatter(0, run, recording)
    extended: Any = _Offset(system, found, of_run)
    equations: Equations = extended
    return equations
