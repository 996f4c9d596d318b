"""A fitted system of differential equations with its effects, simulated on a new recording."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.nonlinear import fit
from mkc_torch.simulation.affine_rounds import fitted_in_rounds
from mkc_torch.simulation.continuation import Continuation
from mkc_torch.simulation.dynamics.initial_states import InitialStates, OwnStates
from mkc_torch.simulation.dynamics.missing import recorded_weight
from mkc_torch.simulation.dynamics.prepared import PreparedDynamics
from mkc_torch.simulation.parameter import SimulationError
from mkc_torch.simulation.ports import Changes, Nearby

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

_HORIZONS = (0.1, 0.3, 1.0)
"""Shares of the longest run, from its start, to which the initial states are fitted in turn."""

_SAMPLES_PER_STATE = 5
"""Samples for each initial state; shorter horizons are skipped."""

_TOLERANCE, _ROUNDS = 1e-8, 10
"""Gain in nats per sample below which the rounds of a simulation that steps end, and their largest number."""


class DynamicsCorrection:
    """A simulation with known parameters and effects on a new recording; only its initial states are estimated.

    Args:
        prepared: the differential equations with the new recording, which provides the inputs and the outputs for
            the estimate of the initial states.
        first: s from the start of each trajectory that the initial states are estimated from; None for the system's
            ``initial_window``.
    """

    def __init__(self, prepared: PreparedDynamics, first: float | None = None) -> None:
        self.prepared = prepared
        self.first = prepared.system.initial_window if first is None else first
        self.recording, self.time = self.prepared.recording, self.prepared.time
        self.ports = self.prepared.ports

    def corrected(self, theta: Float[Tensor, " p"], changes: Changes) -> dict[str, Float[Tensor, " N"]]:
        """Simulate the outputs.

        Returns:
            Columns ``time``, ``experiment`` where the recording has it, and each output, (N,).

        Raises:
            SimulationError: no trajectory is found.
        """
        outputs = self.simulated(theta, changes, self.initial_states(theta, changes))
        table = self.prepared.recording
        runs = {"experiment": table["experiment"]} if "experiment" in table else {}
        return {"time": self.time} | runs | dict(zip(self.prepared.channels, outputs.unbind(-1), strict=True))

    def finer(self) -> DynamicsCorrection | None:
        """The same with half the step of integration; None with the user's step or the smallest one."""
        prepared = self.prepared.finer()
        return None if prepared is None else DynamicsCorrection(prepared, self.first)

    def simulated(self, theta: Float[Tensor, " p"], changes: Changes, starts: InitialStates) -> Float[Tensor, "N m"]:
        """Simulate the outputs from known initial states, (N, m)."""
        known = theta[: len(self.prepared.known)]
        return self.prepared.simulated(torch.cat([known, starts.values]), changes, starts.near)

    def initial_states(
        self, theta: Float[Tensor, " p"], changes: Changes, start: Float[Tensor, " s"] | None = None
    ) -> InitialStates:
        """Estimate the initial states of all trajectories.

        Args:
            theta: (p,), the parameters.
            changes: the changes at the ports.
            start: (s,), values near the estimate; None for the first guess.

        Raises:
            SimulationError: no trajectory is found.
        """
        prepared = self.prepared
        known = theta[: len(prepared.known)]
        own = self.own_states
        first = prepared.given[len(known) :] if start is None else start
        # stiff friction can defeat Newton's method from the guess; the fit then starts from this trajectory
        found = prepared.trajectory(torch.cat([known, first]), changes, patient=True)
        if not found.converged:
            raise SimulationError(
                f"{prepared.name}: no trajectory was found for this model's parameters and effects from the "
                "initial states of this recording. Give a smaller `step`, or split the recording into shorter runs."
            )
        begin = own.free(first)
        near: Nearby | None = found
        for seen in self._horizons():
            if int(seen.sum()) > _SAMPLES_PER_STATE * len(begin) or bool(seen.all()) or self.first is not None:
                weight = seen.to(theta.dtype)
                if prepared.recorded is not None:
                    weight = recorded_weight(prepared.recorded, weight)
                continuation = Continuation(prepared, partial(_with_states, known, changes, own), near)
                by = partial(fit, weight=weight, covariance=None, graduate=start is None, max_iter=60)
                steps = fitted_in_rounds(continuation, begin, by, weight, _TOLERANCE, _ROUNDS)
                begin = (by(continuation, begin) if steps is None else steps).theta
                near = continuation.near(begin)
        return InitialStates(own.all(begin), near)

    @property
    def own_states(self) -> OwnStates:
        """Which initial states are estimated."""
        system = self.prepared.system
        trajectories = int(self.prepared.begins.sum())
        return OwnStates.of(system.states, system.starts_as, trajectories)

    def _horizons(self) -> list[Bool[Tensor, " N"]]:
        """Masks of the samples that the initial states are fitted to, over growing horizons from each run's start.

        A fit to all samples at once can end in a local minimum: a pendulum simulated slightly too fast goes over
        the top and never returns.
        """
        since = self.prepared.time_since_start()
        if self.first is not None:
            return [since <= self.first]
        return [since <= share * since.max() for share in _HORIZONS]


def _with_states(
    known: Float[Tensor, " p"], changes: Changes, own: OwnStates, begin: Float[Tensor, " f"]
) -> tuple[Float[Tensor, " q"], Changes]:
    """Return the parameters with the initial states, and the changes."""
    return torch.cat([known, own.all(begin)]), changes
