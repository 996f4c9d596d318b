"""The interface of a system of differential equations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

from torch import Tensor

from mkc_torch.simulation.own_offsets import OwnOffset
from mkc_torch.simulation.parameter import Parameter

__all__ = ["Equations"]


class Equations(Protocol):
    """Names, parameters and functions of a system; see :class:`mkc_torch.simulation.Dynamics`.

    Attributes:
        name: name of the simulation in ``diagnosis.json``.
        states, inputs, outputs, parameters, initial, units, input_hold, restart_after, step, initial_window: see
            :class:`mkc_torch.simulation.Dynamics`.
        own_offsets: offsets of outputs in single recordings, the last parameters.
    """

    @property
    def name(self) -> str: ...
    @property
    def states(self) -> tuple[str, ...]: ...
    @property
    def inputs(self) -> tuple[str, ...]: ...
    @property
    def outputs(self) -> tuple[str, ...]: ...
    @property
    def parameters(self) -> Mapping[str, float | Parameter]: ...
    @property
    def initial(self) -> Mapping[str, float]: ...
    @property
    def units(self) -> Mapping[str, str]: ...
    @property
    def input_hold(self) -> str: ...
    @property
    def restart_after(self) -> float | None: ...
    @property
    def step(self) -> float | None: ...
    @property
    def initial_window(self) -> float | None: ...
    @property
    def own_offsets(self) -> tuple[OwnOffset, ...]: ...

    def derivative(self, time: Tensor, x: Any, u: Any, p: Any) -> Mapping[str, Tensor] | Sequence[Tensor]: ...
    def output(self, time: Tensor, x: Any, u: Any, p: Any) -> Mapping[str, Tensor]: ...
    def actuator(self, time: Tensor, u: Any, p: Any, run: Tensor) -> Mapping[str, Tensor]: ...
    def sensor(self, time: Tensor, y: Mapping[str, Tensor], p: Any, run: Tensor) -> Mapping[str, Tensor]: ...
