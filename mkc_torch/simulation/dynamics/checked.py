"""The start of a fit of differential equations, and checks of its parameters there."""

from __future__ import annotations

from functools import cached_property, partial
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.dual_constants import dual_constants
from mkc_torch.nonlinear import load_forward_mode
from mkc_torch.recording.recording import Recording
from mkc_torch.simulation.dynamics.observed import ObservedDynamics
from mkc_torch.simulation.dynamics.trajectory import Grid, Trajectory
from mkc_torch.simulation.dynamics.user_functions import namespace
from mkc_torch.simulation.names import Names, watched
from mkc_torch.simulation.ports import Changes, Nearby
from mkc_torch.simulation.start_checks import Sensitivity, StartCheck, bound_checks, moved_inside, parameter_checks
from mkc_torch.simulation.undetermined import undetermined

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

AT_START = ("_start", "_moved", "_at_start", "warnings", "checks")
"""Cached results near the start of the fit, which depend on the grid and the inputs between samples."""

_NOUGHT = 1e-3
"""Share of a parameter's start value below which its fitted value does not define its size."""


class CheckedDynamics(ObservedDynamics):
    """A prepared system with the start of its fit; a derived class provides the trajectory and the residual."""

    recording: Recording
    grid: Grid
    bounds: tuple[Tensor, Tensor]

    def start(self, rows: Bool[Tensor, " N"] | None = None) -> Float[Tensor, " p"]:
        raise NotImplementedError

    def trajectory(self, theta: Float[Tensor, " p"], changes: Changes, near: Nearby | None = None) -> Trajectory:
        raise NotImplementedError

    def residual(
        self, theta: Float[Tensor, " p"], changes: Changes, near: Nearby | None = None
    ) -> Float[Tensor, "N m"]:
        raise NotImplementedError

    def open_loop(self) -> CheckedDynamics:
        raise NotImplementedError

    @property
    def given(self) -> Float[Tensor, " p"]:
        """The user's values, moved inside their bounds, then the first guess of the initial states."""
        given = self._as_given.clone()
        for number, value in self._moved.items():
            given[number] = value
        return given

    @property
    def _as_given(self) -> Float[Tensor, " p"]:
        values = self.time.new_tensor([parameter.value for parameter in self.known.values()])
        return torch.cat([values, self.guess[self.grid.begins].flatten()])

    @cached_property
    def _moved(self) -> dict[int, float]:
        """Start values that replace those at a bound."""
        return moved_inside(list(self.known.values()), lambda: self._sensitivity(self._as_given))

    def _sensitivity(self, theta: Float[Tensor, " p"]) -> Sensitivity:
        load_forward_mode()
        near = self.trajectory(theta, {})
        tangents = torch.func.jacfwd(dual_constants(lambda values: self.residual(values, {}, near)))(theta)
        # a value near 0 does not define the parameter's size
        meant = theta.new_tensor([parameter.value for parameter in self.known.values()])
        typical = self.guess.abs().median(0).values.repeat(int(self.begins.sum()))
        meant = torch.cat([meant.abs(), typical])
        size = torch.where(theta.abs() < _NOUGHT * meant, meant, theta.abs())
        return Sensitivity(theta, torch.where(size > 0, size, 1.0), tangents, self.measured.std(0))

    @cached_property
    def _at_start(self) -> Sensitivity:
        return self._sensitivity(self.start())

    @cached_property
    def warnings(self) -> tuple[str, ...]:
        """Warnings about parameters that the recording does not determine, near the start of the fit."""
        if not self.known:
            return ()
        if self.observer is not None:
            return self.open_loop().warnings
        at = self._at_start
        return undetermined(at.tangents.flatten(0, 1), at.size, self.parameter_names, len(self.known))

    @cached_property
    def checks(self) -> tuple[StartCheck, ...]:
        """Checks of the equations' parameters near the start of the fit."""
        if self.observer is not None:
            return self.open_loop().checks
        names = list(self.known)
        if not names:
            return ()
        residual = partial(self.residual, changes={}, near=self.trajectory(self.start(), {}))
        read = self._read
        found = parameter_checks(self._at_start, names, residual, lambda number: names[number] in read)
        return (*found, *bound_checks(names, list(self.known.values()), self._moved))

    @property
    def _read(self) -> set[str]:
        """Names of the parameters that a function of the system reads."""
        system, theta = self.system, self.start()
        p, read = watched(vars(self.parameters_of(theta)))
        u = Names(**dict(zip(system.inputs, self.inputs.unbind(-1), strict=True)))
        system.actuator(self.clock.time, u, p, self.run[self.clock.before])
        system.derivative(self.clock.time, namespace(system.states, self.grid.spread(self.guess)), u, p)
        x, v = namespace(system.states, self.guess[self.rows]), namespace(system.inputs, self.inputs_at_rows)
        system.sensor(self.time, system.output(self.time, x, v, p), p, self.run)
        return read
