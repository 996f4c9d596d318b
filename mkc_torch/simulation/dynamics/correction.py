"""Differential equations with their effects, on a new recording."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.nonlinear import fit
from mkc_torch.simulation.continuation import Continuation
from mkc_torch.simulation.dynamics.prepared import PreparedDynamics
from mkc_torch.simulation.parameter import SimulationError
from mkc_torch.simulation.protocol import Changes, Nearby

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

__all__ = ["DynamicsCorrection"]

_HORIZONS, _ENOUGH = (0.1, 0.3, 1.0), 5
"""Shares of a recording from which first states are estimated one after the other, and samples for each of them."""


class DynamicsCorrection:
    """A simulation with its parameters and effects on a new recording: only the first states are estimated anew.

    Args:
        prepared: the differential equations with the new recording: its inputs, and outputs from which the first
            states are estimated.
        first: in s, how much of each run they are estimated from; None for what the system says.
    """

    def __init__(self, prepared: PreparedDynamics, first: float | None = None) -> None:
        self.prepared = prepared
        self.first = prepared.system.initial_window if first is None else first
        self.time = self.prepared.time
        self.ports = self.prepared.ports

    def corrected(self, theta: Float[Tensor, " p"], changes: Changes) -> dict[str, Float[Tensor, " N"]]:
        """The outputs as simulated, with the runs' numbers where there are several."""
        prepared = self.prepared
        p = len(prepared.known)

        first = prepared.start()[p:]
        # friction that sticks at once leaves Newton's method far behind; a fit then begins with what was found
        found = prepared.trajectory(torch.cat([theta[:p], first]), changes, patient=True)
        if not found.converged:
            raise SimulationError(
                f"{prepared.name}: with the parameters and effects of this model no trajectory was found that begins "
                "as this recording does. Give a smaller `step`, or split the recording into shorter runs."
            )
        begin = first
        near: Nearby | None = found
        for seen in self._horizons():
            if int(seen.sum()) > _ENOUGH * len(begin) or bool(seen.all()) or self.first is not None:
                weight = seen.to(theta.dtype)
                way = Continuation(prepared, lambda begin: (torch.cat([theta[:p], begin]), changes), near)
                begin = fit(way, begin, weight=weight, covariance=None, graduate=True, max_iter=60).theta
                near = way.near(begin)
        outputs = prepared.simulated(torch.cat([theta[:p], begin]), changes, near)
        table = prepared.recording
        runs = {"experiment": table["experiment"]} if "experiment" in table else {}
        return {"time": self.time} | runs | dict(zip(prepared.channels, outputs.unbind(-1), strict=True))

    def _horizons(self) -> list[Bool[Tensor, " N"]]:
        """The samples that the first states are estimated from, first those soon after a run's beginning.

        A pendulum that is a little too fast goes over the top, and from there nothing leads back.
        """
        since = self.prepared.since_begin()
        if self.first is not None:
            return [since <= self.first]
        return [since <= share * since.max() for share in _HORIZONS]
