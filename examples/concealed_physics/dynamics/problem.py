"""A case in the form that the baselines use: runs as tensors, and the error of a free run."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import TYPE_CHECKING

import torch
from free_run import Rate, Runs, error, first_states, free_run, named, outputs_of, runs_of, windows
from library import PHYSICS, Physics
from systems import Case
from torch import Tensor

from mkc_torch import diagnose
from mkc_torch.recording.recording import Recording

if TYPE_CHECKING:
    from jaxtyping import Float

FITTED = 0.7
"""Share of each training run that is fitted while settings are chosen; the rest judges them."""


@dataclass(frozen=True)
class Outcome:
    """Result of a method on the unseen runs.

    Attributes:
        errors: error of each unseen run, in the unit of the recording; infinite if the run diverges.
        name: name of the physics that it found.
        settings: chosen settings.
        seconds: processor time in s.
    """

    errors: list[float]
    name: str
    settings: str
    seconds: float = 0.0


@dataclass(frozen=True)
class Problem:
    """A case in the form that the baselines use.

    Attributes:
        case: recordings and simulation.
        physics: knowledge of the system.
        fitted: parameters of the plain simulation.
        train: training runs.
        tests: unseen runs.
    """

    case: Case
    physics: Physics
    fitted: Float[Tensor, " p"]
    train: Runs
    tests: list[Runs]

    @property
    def outputs(self) -> list[int]:
        """Indices of the measured states."""
        names = outputs_of(self.case.system, self.case.train)
        return [self.case.system.states.index(name) for name in names]

    @property
    def targets(self) -> list[int]:
        """Indices of the states with unknown rates."""
        return [self.case.system.states.index(state) for state in self.physics.own]

    def names(self, x: Tensor, u: Tensor) -> tuple[SimpleNamespace, SimpleNamespace, SimpleNamespace]:
        """Return states, inputs and fitted parameters as attributes."""
        system = self.case.system
        return named(system.states, x), named(system.inputs, u), named(tuple(system.parameters), self.fitted)

    def from_measured(self, runs: Runs) -> Float[Tensor, "N R n"]:
        """Return the measured states; speeds are differences of positions."""
        values = runs.measured.new_zeros(*runs.time.shape, len(self.case.system.states))
        values[..., self.outputs] = runs.measured
        for state in range(values.shape[-1]):
            if state not in self.outputs:  # the speed, which follows the position
                step = runs.time.diff(dim=0)
                slope = values[..., state - 1].diff(dim=0) / torch.where(step > 0, step, torch.inf)
                values[..., state] = torch.cat([slope[:1], 0.5 * (slope[1:] + slope[:-1]), slope[-1:]])
        return values

    def simulate(self, rate: Rate, runs: Runs, seconds: float | None, models: int = 0) -> Tensor:
        """Return the outputs of a free run; its first states are estimated from the first ``seconds`` alone."""
        guess = self.from_measured(runs)[0]
        if models:
            guess = guess.expand(models, *guess.shape)
        begin = first_states(rate, guess, runs, self.outputs, seconds)
        return free_run(rate, begin, runs)[..., self.outputs]

    def judged(self, rate: Rate, models: int = 0) -> Tensor:
        """Return the open-loop error on the held-out part of the training runs."""
        begins, absolute = self.case.system.initial_window, self.physics.absolute
        since = self.train.since
        held_out = self.train.present & (since > FITTED * since[-1])
        if self.physics.piece:
            cut = windows(replace(self.train, present=held_out), self.physics.piece)
            scored = cut.present.all(0) & (cut.since > self.case.scored_from)
            return error(self.simulate(rate, cut, begins, models), cut, scored, absolute=absolute)
        last = float(FITTED * since[-1].min())
        simulated = self.simulate(rate, self.train, last if begins is None else min(begins, last), models)
        return error(simulated, self.train, held_out, absolute=absolute)

    def seen(self, rate: Rate) -> float:
        """Return the open-loop error on all training runs."""
        simulated = self.simulate(rate, self.train, self.case.system.initial_window)
        return float(error(simulated, self.train, self.train.present, absolute=self.physics.absolute))

    def with_drives(self, x: Float[Tensor, "*batch n"], u: Tensor) -> Float[Tensor, "*batch n+d"]:
        """Return the states and the driving terms of the inputs."""
        if not u.shape[-1]:
            return x
        drives = self.physics.drives(*self.names(x, u))
        return torch.cat([x, *(drive.expand(x.shape[:-1]).unsqueeze(-1) for drive in drives)], -1)

    def in_unit(self, value: float) -> str:
        """Format an error with its unit."""
        return f"{value * self.physics.factor:.3g} {self.physics.unit}" if math.isfinite(value) else "diverged"

    def unseen(self, rate: Rate) -> list[float]:
        """Return the errors on the unseen runs."""
        found = []
        for runs in self.tests:
            scored = runs.present & (runs.since > self.case.scored_from)
            simulated = self.simulate(rate, runs, self.case.system.initial_window)
            found.append(float(error(simulated, runs, scored, absolute=self.physics.absolute)))
        return found


def problem_of(case: Case, fitted: Tensor) -> Problem:
    """Return the case in the form that the baselines use."""
    physics = PHYSICS[case.system.name]
    tests = [runs_of(case.system, test, physics.parts) for test in case.tests.values()]
    return Problem(case, physics, fitted, runs_of(case.system, case.train, physics.parts), tests)


def plain(case: Case) -> tuple[Tensor, list[float]]:
    """Return the fitted parameters of the simulation, and its errors on the unseen runs."""
    absolute = PHYSICS[case.system.name].absolute
    model = diagnose(case.system, case.train, effects=(), max_findings=0).model
    assert model is not None
    errors = [recorded_error(case, test, model(test), absolute=absolute) for test in case.tests.values()]
    theta = model.state_dict()["theta"]
    assert isinstance(theta, Tensor)
    return theta[: len(case.system.parameters)].clone(), errors


def shortened(case: Case) -> Case:
    """Return the case with the first part of its training runs and without unseen runs, to choose settings on."""
    recording = case.train
    keep = torch.ones(len(recording), dtype=torch.bool)
    group = recording["experiment"] if "experiment" in recording else torch.zeros(len(recording))
    for value in group.unique():
        here = group == value
        since = recording["time"] - recording["time"][here][0]
        keep &= ~here | (since <= FITTED * since[here][-1])
    return replace(case, train=Recording({name: recording[name][keep] for name in recording.names}), tests={})


def recorded_error(case: Case, test: Recording, simulated: Mapping[str, Tensor], *, absolute: bool) -> float:
    """Return the error of simulated outputs, where they are scored."""
    names = outputs_of(case.system, test)
    away = test.stack(*names) - torch.stack([simulated[name] for name in names], -1)
    away = away[test["time"] - test["time"][0] > case.scored_from]
    return float(away.abs().mean() if absolute else away.square().mean().sqrt())
