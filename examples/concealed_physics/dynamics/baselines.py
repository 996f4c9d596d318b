"""PySINDy and a small neural ODE compared with the simulations: same training runs, unseen runs and error measure.

Both are tuned inside the training runs: fitted on the first part of each, judged by a free run over the rest, and then
refitted on all of it. PySINDy's library has the terms of the simulation and those of the catalogue that can be
written as a sum of known functions of states and inputs; delays, lags and saturations cannot. The neural ODE adds a
perceptron to the rates that the simulation knows, whose parameters are trained with it; it names nothing.

PySINDy: de Silva et al., JOSS 5(49), 2104 (2020); Kaptanoglu et al., JOSS 7(69), 3994 (2022). Thresholded least
squares: Brunton, Proctor & Kutz, PNAS 113(15), 3932 (2016). Neural ODE: Chen et al., NeurIPS 2018; multiple shooting:
Bock & Plitt, IFAC World Congress 1984.
"""

from __future__ import annotations

import argparse
import importlib.util
import math
import time
import warnings
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, product
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import torch
from free_run import (
    Rate,
    Runs,
    as_array,
    error,
    first_states,
    free_run,
    named,
    outputs_of,
    rate_of,
    runs_of,
    spread,
    windows,
)
from held_out import DATA, finding_text, prove
from systems import Case, balls, heaters, servo, silverbox
from torch import Tensor
from torch.nn.functional import linear

from mkc_torch import diagnose
from mkc_torch.recording.recording import Recording

if TYPE_CHECKING:
    from jaxtyping import Float

FITTED = 0.7
"""Share of each training run that is fitted while settings are chosen; the rest judges them."""
THRESHOLDS = (0.0, 0.003, 0.01, 0.03, 0.06, 0.1, 0.2, 0.4)
"""Smallest share of a rate's norm for which a term is kept."""
RIDGES = (1e-6, 0.05)
"""The second is PySINDy's own."""
ORDERS = (2, 4, 8, 16)
SMOOTHED_OVER = (5, 9, 15, 25, 51, 101)
"""Settings of the differentiation: orders of differences, and samples that Savitzky and Golay smooth over."""
WIDTHS = (0.3, 0.1)
PLACES = (0.65, 0.9)
"""Of the smoothed sign and of the stops, as shares of the typical speed and the largest deflection."""
NEARLY = 1.05
"""The candidate with the fewest terms is chosen among those with a held-out error within this factor of the least."""
HIDDEN = 16
EPOCHS = 300
CHECKS = 5
RATE = 1e-2
"""The neural ODE's: units in each of two layers, epochs, how often it is judged, and Adam's learning rate."""
JOINED = 1.0
"""Weight of the gaps between the windows of multiple shooting, relative to the data."""

METHODS = ("PySINDy", "neural ODE")
SYSTEMS: dict[str, Callable[[Path], list[Case]]] = {
    "balls": balls,
    "heaters": lambda data: [heaters(data)],
    "silverbox": lambda data: [silverbox(data)],
    "servo": lambda data: [servo(data)],
}

T = TypeVar("T")
Terms = dict[str, Callable[[], Tensor]]
"""By name, each computed when it is called for."""


@dataclass(frozen=True)
class Shape:
    """Where the terms that are not linear in their parameters bend, in the states' units."""

    width: float = 1.0
    stribeck: float = 1.0
    place: float = 1.0


@dataclass(frozen=True)
class Physics:
    """Knowledge of a system that the baselines get.

    Attributes:
        own: per state, the terms that the simulation has in its rate.
        more: per state, those of the catalogue.
        terms: all of them, from the states, the inputs, the simulation's fitted parameters and the shapes.
        drives: what the inputs drive the system by, for the neural ODE.
        parts: of an interval between samples, in a free run.
        windows: steps in a window of multiple shooting, to choose from.
        piece: steps of the pieces that the held-out part is simulated in, each from its own start; 0 for a free run
            from the start of the run.
        absolute: the measure is the mean absolute error, and not the root mean square.
        unit, factor: unit of reported errors, and its number in the recording's unit.
        shapes: whether the library has terms that bend somewhere.
    """

    own: Mapping[str, tuple[str, ...]]
    more: Mapping[str, tuple[str, ...]]
    terms: Callable[[SimpleNamespace, SimpleNamespace, SimpleNamespace, Shape], Terms]
    drives: Callable[[SimpleNamespace, SimpleNamespace, SimpleNamespace], tuple[Tensor, ...]]
    parts: int
    windows: tuple[int, ...]
    absolute: bool
    unit: str
    piece: int = 0
    factor: float = 1.0
    shapes: bool = False


def friction(v: Tensor, load: Callable[[], Tensor], shape: Shape) -> Terms:
    """Dry friction: constant, rising towards standstill, and in proportion to the load."""

    def sign() -> Tensor:
        return torch.tanh(v / shape.width)

    return {
        "sign(v)": sign,
        "sign(v) exp(-(v/s)^2)": lambda: sign() * torch.exp(-((v / shape.stribeck) ** 2)),
        "sign(v) |load|": lambda: sign() * load().abs(),
    }


def stops(x: Tensor, shape: Shape) -> Terms:
    """Stiff springs beyond a place on either side."""
    return {
        "max(x - c, 0)": lambda: (x - shape.place).clamp(min=0.0),
        "max(-c - x, 0)": lambda: (-shape.place - x).clamp(min=0.0),
    }


def ball_terms(x: SimpleNamespace, _u: SimpleNamespace, _p: SimpleNamespace, _shape: Shape) -> Terms:
    """Return the terms for a body in the air."""
    v = x.speed
    return {"1": lambda: torch.ones_like(v), "v": lambda: v, "v|v|": lambda: v * v.abs()}


def heater_terms(x: SimpleNamespace, u: SimpleNamespace, _p: SimpleNamespace, _shape: Shape) -> Terms:
    """Of two bodies that are heated, exchange heat and radiate."""
    first, second = x.temperature_1, x.temperature_2
    return {
        "1": lambda: torch.ones_like(first),
        "T1": lambda: first,
        "T2": lambda: second,
        "Q1": lambda: u.heater_1.expand_as(first),
        "Q2": lambda: u.heater_2.expand_as(first),
        "T2 - T1": lambda: second - first,
        "T1 - T2": lambda: first - second,
        "T1^4": lambda: ((first + 273.15) / 293.15) ** 4,
        "T2^4": lambda: ((second + 273.15) / 293.15) ** 4,
        "T1|T1|": lambda: first * first.abs(),
        "T2|T2|": lambda: second * second.abs(),
    }


def silverbox_terms(x: SimpleNamespace, u: SimpleNamespace, p: SimpleNamespace, shape: Shape) -> Terms:
    """Return the terms for a driven oscillator."""
    y, v = x.output, x.speed

    def load() -> Tensor:
        return p.gain * (u.input + p.offset) - p.stiffness * y

    known: Terms = {
        "1": lambda: torch.ones_like(v),
        "x": lambda: y,
        "v": lambda: v,
        "u": lambda: u.input.expand_as(v),
        "x^3": lambda: y**3,
        "v|v|": lambda: v * v.abs(),
    }
    return known | friction(v, load, shape) | stops(y, shape)


def servo_terms(x: SimpleNamespace, u: SimpleNamespace, p: SimpleNamespace, shape: Shape) -> Terms:
    """Return the terms for a motor with a pendulum."""
    angle, v = x.position, x.speed

    def load() -> Tensor:
        return p.drive * servo_drive(x, u, p) - p.gravity * angle.sin()

    known: Terms = {
        "V duty": lambda: servo_drive(x, u, p),
        "v": lambda: v,
        "sin x": lambda: angle.sin(),
        "1": lambda: torch.ones_like(v),
        "x^3": lambda: angle**3,
        "v|v|": lambda: v * v.abs(),
        "cos x": lambda: angle.cos(),
        "sin 2x": lambda: (2 * angle).sin(),
        "cos 2x": lambda: (2 * angle).cos(),
    }
    return known | friction(v, load, shape) | stops(angle, shape)


def servo_drive(x: SimpleNamespace, u: SimpleNamespace, p: SimpleNamespace) -> Tensor:
    """The motor's share of its supply, by the law of control that the simulation assumes."""
    return u.torque_enable * torch.clamp(p.gain * u.kp * (u.goal_position - x.position), -1.0, 1.0)


FRICTION = ("sign(v)", "sign(v) exp(-(v/s)^2)", "sign(v) |load|")
STOPS = ("max(x - c, 0)", "max(-c - x, 0)")
PHYSICS = {
    "Ball": Physics(
        own={"speed": ()},
        more={"speed": ("1", "v", "v|v|")},
        terms=ball_terms,
        drives=lambda *_: (),
        parts=1,
        windows=(8, 16),
        absolute=True,
        unit="m",
    ),
    "Heaters": Physics(
        own={"temperature_1": ("1", "T1", "Q1"), "temperature_2": ("1", "T2", "Q2")},
        more={"temperature_1": ("T2 - T1", "T1^4", "T1|T1|"), "temperature_2": ("T1 - T2", "T2^4", "T2|T2|")},
        terms=heater_terms,
        drives=lambda _x, u, _p: (u.heater_1, u.heater_2),
        parts=1,
        windows=(15, 45),
        absolute=False,
        unit="°C",
    ),
    "Silverbox": Physics(
        own={"speed": ("1", "x", "v", "u")},
        more={"speed": ("x^3", "v|v|", *FRICTION, *STOPS)},
        terms=silverbox_terms,
        drives=lambda _x, u, _p: (u.input,),
        parts=2,
        windows=(8, 24),
        absolute=False,
        unit="mV",
        piece=614,
        factor=1e3,
        shapes=True,
    ),
    "Servo": Physics(
        own={"speed": ("V duty", "v", "sin x")},
        more={"speed": ("1", "x^3", "v|v|", "cos x", "sin 2x", "cos 2x", *FRICTION, *STOPS)},
        terms=servo_terms,
        drives=lambda x, u, p: (servo_drive(x, u, p),),
        parts=2,
        windows=(8, 24),
        absolute=True,
        unit="rad",
        shapes=True,
    ),
}


@dataclass(frozen=True)
class Outcome:
    """Result of a method on the unseen runs.

    Attributes:
        errors: of each unseen run, in the recording's unit; infinite where it diverges.
        name: what it found.
        settings: those that were chosen.
        seconds: of the processor.
    """

    errors: list[float]
    name: str
    settings: str
    seconds: float = 0.0


@dataclass(frozen=True)
class Problem:
    """A case laid out for the baselines.

    Attributes:
        case, physics: what it is of.
        fitted: parameters of the plain simulation.
        train: the runs to learn from.
        tests: the unseen ones.
    """

    case: Case
    physics: Physics
    fitted: Float[Tensor, " p"]
    train: Runs
    tests: list[Runs]

    @property
    def outputs(self) -> list[int]:
        """Which states are measured."""
        names = outputs_of(self.case.system, self.case.train)
        return [self.case.system.states.index(name) for name in names]

    @property
    def targets(self) -> list[int]:
        """The states whose rates are to be found; the others' are known."""
        return [self.case.system.states.index(state) for state in self.physics.own]

    def names(self, x: Tensor, u: Tensor) -> tuple[SimpleNamespace, SimpleNamespace, SimpleNamespace]:
        """States, inputs and fitted parameters as attributes."""
        system = self.case.system
        return named(system.states, x), named(system.inputs, u), named(tuple(system.parameters), self.fitted)

    def from_measured(self, runs: Runs) -> Float[Tensor, "N R n"]:
        """States as they are measured, and speeds as differences of positions."""
        values = runs.measured.new_zeros(*runs.time.shape, len(self.case.system.states))
        values[..., self.outputs] = runs.measured
        for state in range(values.shape[-1]):
            if state not in self.outputs:  # the speed, which follows the position
                step = runs.time.diff(dim=0)
                slope = values[..., state - 1].diff(dim=0) / torch.where(step > 0, step, torch.inf)
                values[..., state] = torch.cat([slope[:1], 0.5 * (slope[1:] + slope[:-1]), slope[-1:]])
        return values

    def simulate(self, rate: Rate, runs: Runs, seconds: float | None, models: int = 0) -> Tensor:
        """Outputs in a free run, its first states estimated from the first seconds alone."""
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
        """An error with its unit."""
        return f"{value * self.physics.factor:.3g} {self.physics.unit}" if math.isfinite(value) else "diverged"

    def unseen(self, rate: Rate) -> list[float]:
        """Errors on the unseen runs."""
        found = []
        for runs in self.tests:
            scored = runs.present & (runs.since > self.case.scored_from)
            simulated = self.simulate(rate, runs, self.case.system.initial_window)
            found.append(float(error(simulated, runs, scored, absolute=self.physics.absolute)))
        return found


def problem_of(case: Case, fitted: Tensor) -> Problem:
    """The case laid out."""
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
    """The case with the part of its training runs that is fitted while settings are chosen, and nothing unseen."""
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


def ours(case: Case) -> Outcome:
    """Return the result of `diagnose`, as in the example of the system."""
    findings = 3 if case.name == "heaters" else 1
    proofs = prove(case.system, case.train, list(case.tests.values()), max_findings=findings)
    scored = [proof.time - proof.time[0] > case.scored_from for proof in proofs]
    absolute = PHYSICS[case.system.name].absolute
    errors = [
        (proof.mean_absolute(rows) if absolute else proof.root_mean_square(rows))[1]
        for proof, rows in zip(proofs, scored, strict=True)
    ]
    return Outcome(errors, finding_text(proofs[0].diagnosis), "as in the example")


@dataclass(frozen=True)
class Setting:
    """Of PySINDy: how it differentiates, what the terms are added to, and the regression."""

    differentiation: str
    corrects: bool
    threshold: float
    ridge: float
    width: float
    place: float


@dataclass(frozen=True)
class Sparse:
    """Terms with their coefficients, (terms, states)."""

    setting: Setting
    shape: Shape
    base: Float[Tensor, " p"]
    coefficients: Float[Tensor, "T n"]


def differentiations() -> dict[str, Any]:
    """PySINDy's methods to choose from."""
    from pysindy import FiniteDifference, SmoothedFiniteDifference

    plain = {f"differences of order {o}": FiniteDifference(order=o, drop_endpoints=True) for o in ORDERS}
    return plain | {
        f"Savitzky-Golay over {w}": SmoothedFiniteDifference(smoother_kws={"window_length": w, "polyorder": 3})
        for w in SMOOTHED_OVER
    }


def differentiated(method: Any, problem: Problem, runs: Runs) -> tuple[Tensor, Tensor, Tensor]:
    """States (S, n), rates to be found (S, t) and inputs (S, u) of all samples where there is a derivative."""
    targets, n = problem.targets, len(problem.case.system.states)
    parts: list[tuple[Tensor, Tensor, Tensor]] = []
    for run in range(runs.time.shape[1]):
        here = runs.present[:, run]
        t, y = as_array(runs.time[here, run]), as_array(runs.measured[here, run])
        smooth = np.full((len(t), n), np.nan)
        slope = np.asarray(method(y, t))
        smooth[:, problem.outputs] = getattr(method, "smoothed_x_", y)
        if n > len(problem.outputs):  # the speed is the slope of the position
            smooth[:, targets] = slope
            inside = np.isfinite(slope[:, 0])
            slope = np.full_like(slope, np.nan)
            slope[inside] = method(smooth[inside][:, targets], t[inside])
        inputs = torch.cat([runs.inputs[:, 0, run], runs.inputs[-1:, -1, run]])[here]
        parts.append((torch.from_numpy(smooth), torch.from_numpy(slope), inputs))
    x, rates, u = (torch.cat(column) for column in zip(*parts, strict=True))
    good = x.isfinite().all(-1) & rates.isfinite().all(-1)
    return x[good], rates[good], u[good]


def thresholded(terms: Float[Tensor, "S T"], rate: Float[Tensor, " S"], threshold: float, ridge: float) -> Tensor:
    """Coefficients by PySINDy's STLSQ; a term's share of the rate's norm is at least the threshold."""
    from pysindy import STLSQ

    norm = rate.norm()
    reached = terms.abs().amax(0) > 0  # a stop may never be
    regression = STLSQ(threshold=threshold, alpha=ridge, normalize_columns=True)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Sparsity parameter is too big")
        regression.fit(as_array(terms[:, reached]), as_array(rate / norm).reshape(-1, 1))
    coefficients = terms.new_zeros(terms.shape[1])
    coefficients[reached] = torch.from_numpy(np.asarray(regression.coef_)[0]) * norm
    return coefficients


def sparse_candidates(problem: Problem, runs: Runs, settings: Sequence[Setting]) -> list[Sparse]:
    """A model by each setting; settings that need more samples than a run has are left out."""
    methods, physics = differentiations(), problem.physics
    columns = {state: physics.own[state] + physics.more[state] for state in physics.own}
    shortest = int(runs.present.sum(0).min())
    data: dict[str, tuple[Tensor, Tensor, Tensor]] = {}
    found = []
    for setting in settings:
        name = setting.differentiation
        if samples_needed(name) > shortest:
            continue
        if name not in data:
            data[name] = differentiated(methods[name], problem, runs)
        x, rates, u = data[name]
        base = problem.fitted if setting.corrects else torch.zeros_like(problem.fitted)
        rates = rates - rate_of(problem.case.system, base)(x, u)[:, problem.targets]
        shape = shape_of(x, setting)
        terms = physics.terms(*problem.names(x, u), shape)
        coefficients = x.new_zeros(len(terms), x.shape[-1])
        for place, (state, used) in enumerate(columns.items()):
            rows = [list(terms).index(term) for term in used]
            theta = torch.stack([terms[term]() for term in used], -1)
            column = problem.case.system.states.index(state)
            coefficients[rows, column] = thresholded(theta, rates[:, place], setting.threshold, setting.ridge)
        found.append(Sparse(setting, shape, base, coefficients))
    return found


def samples_needed(differentiation: str) -> int:
    """By a method that is applied twice, so that some are left.

    Example:
        >>> samples_needed("Savitzky-Golay over 25"), samples_needed("differences of order 8")
        (26, 26)
    """
    size = int(differentiation.split()[-1])
    return size + 1 if "over" in differentiation else 2 * size + 10


def shape_of(x: Float[Tensor, "S n"], setting: Setting) -> Shape:
    """Shares of the typical speed and of the largest deflection, in their units."""
    typical, largest = float(x[:, -1].abs().median()), float(x[:, 0].abs().amax())
    return Shape(max(setting.width * typical, 1e-9), max(typical, 1e-9), setting.place * largest)


def sparse_rate(problem: Problem, models: Sequence[Sparse]) -> Rate:
    """Return the rates of several models, (models, R, n)."""
    base = torch.stack([model.base for model in models]).unsqueeze(1)  # (models, 1, p)
    known = rate_of(problem.case.system, base)
    coefficients = torch.stack([model.coefficients for model in models])
    kept = (coefficients != 0.0).any(-1).any(0).nonzero().flatten().tolist()
    coefficients = coefficients[:, kept]

    def per_model(values: Sequence[float]) -> Tensor:
        return coefficients.new_tensor(list(values)).unsqueeze(-1)

    shape: Any = Shape
    shapes = shape(
        per_model([m.shape.width for m in models]),
        per_model([m.shape.stribeck for m in models]),
        per_model([m.shape.place for m in models]),
    )

    def rate(x: Tensor, u: Tensor) -> Tensor:
        if not kept:
            return known(x, u)
        terms = list(problem.physics.terms(*problem.names(x, u), shapes).values())
        return known(x, u) + torch.stack([terms[term]() for term in kept], -1) @ coefficients

    return rate


def single(rate: Rate) -> Rate:
    """Return the model of a batch of one."""
    return lambda x, u: rate(x.unsqueeze(-3), u).squeeze(-3)


def simplest(errors: Sequence[float], sizes: Sequence[int]) -> int:
    """Return the best of the candidates with the fewest terms among those nearly as good as the best.

    Example:
        >>> simplest([2.0, 1.0, 1.04, 1.02], [1, 5, 3, 3])
        3
    """
    best = min(errors)
    near = [index for index, value in enumerate(errors) if value <= NEARLY * best]
    return min(near, key=lambda index: (sizes[index], errors[index]))


def sparse_settings(physics: Physics) -> list[Setting]:
    """All that are tried."""
    widths, places = (WIDTHS, PLACES) if physics.shapes else (WIDTHS[:1], PLACES[:1])
    methods = [f"differences of order {o}" for o in ORDERS] + [f"Savitzky-Golay over {w}" for w in SMOOTHED_OVER]
    bases = (False, True) if any(physics.own.values()) else (False,)
    return [Setting(*item) for item in product(methods, bases, THRESHOLDS, RIDGES, widths, places)]


def term_names(problem: Problem) -> list[str]:
    """Of the library, in the order of the coefficients."""
    system = problem.case.system
    nothing = (problem.fitted.new_zeros(1, len(names)) for names in (system.states, system.inputs))
    return list(problem.physics.terms(*problem.names(*nothing), Shape()))


def equations(problem: Problem, model: Sparse, *, numbers: bool = False) -> str:
    """The terms that are kept, those that the simulation does not have between stars."""
    names, found = term_names(problem), []
    for state, own in problem.physics.own.items():
        column = model.coefficients[:, problem.case.system.states.index(state)]
        rows = column.nonzero().flatten().tolist()
        terms = [names[row] if names[row] in own else f"*{names[row]}*" for row in rows]
        if numbers:
            terms = [f"({float(column[row]):.3g}) {term}" for row, term in zip(rows, terms, strict=True)]
        before = ["simulation"] if model.setting.corrects or not own else []
        found.append(f"{state}' = {' + '.join(before + terms) or '0'}")
    return "; ".join(found)


def sindy(problem: Problem, early: Problem) -> Outcome:
    """PySINDy's model, its settings chosen on the held-out part of the training runs.

    Args:
        problem: with the simulation fitted to all of the training runs.
        early: with the simulation fitted to the part that is not held out.
    """
    tried = sparse_candidates(early, problem.train.until(FITTED), sparse_settings(problem.physics))
    errors = early.judged(sparse_rate(early, tried), len(tried)).tolist()
    sizes = [int(model.coefficients.count_nonzero()) for model in tried]
    index = simplest(errors, sizes)
    setting = tried[index].setting
    both = [(problem, again) for again in sparse_candidates(problem, problem.train, [setting])]
    both.append((early, tried[index]))
    # what is fitted to all of the runs is left only where it does not even simulate these
    of, model = min(both, key=lambda item: item[0].seen(single(sparse_rate(item[0], [item[1]]))))
    settings = (
        f"{setting.differentiation}, threshold {setting.threshold:g}, ridge {setting.ridge:g}"
        + (f", width {setting.width:g}, stops at {setting.place:g}" if problem.physics.shapes else "")
        + (", fitted to the first part alone" if model is tried[index] else "")
        + f"; {len(tried)} tried, held-out error {problem.in_unit(errors[index])}; "
        + equations(of, model, numbers=True)
    )
    return Outcome(of.unseen(single(sparse_rate(of, [model]))), equations(of, model), settings)


@dataclass(frozen=True)
class Network:
    """A perceptron of two layers on scaled states and drives; its output is in the rates' typical size.

    Attributes:
        weights: of the layers, in turns matrices and offsets.
        mean, deviation: of states and drives.
        size: of the rates to be corrected.
    """

    weights: list[Tensor]
    mean: Tensor
    deviation: Tensor
    size: Tensor

    def layers(self) -> list[tuple[Tensor, Tensor]]:
        """Matrices (after, before) and offsets of the layers, with the scales in the first and the last one."""
        first, a, second, b, last, c = self.weights
        inward = first / self.deviation.unsqueeze(-1)
        return [(inward.T, a - self.mean @ inward), (second.T, b), ((last * self.size).T, c * self.size)]


def new_network(problem: Problem, runs: Runs, seed: int) -> Network:
    """Return a network whose correction is 0."""
    x = problem.from_measured(runs)
    u = torch.cat([runs.inputs[:, 0], runs.inputs[-1:, -1]])
    values = problem.with_drives(x, u)
    mean, deviation = spread(values, runs.present)
    step = runs.time.diff(dim=0).unsqueeze(-1)
    slopes = x.diff(dim=0)[..., problem.targets] / torch.where(step > 0, step, torch.inf)
    _, size = spread(slopes, runs.present[1:])
    generator = torch.Generator().manual_seed(seed)
    wide = [values.shape[-1], HIDDEN, HIDDEN, len(problem.targets)]
    weights = []
    for layer, (before, after) in enumerate(pairwise(wide)):
        matrix = torch.randn(before, after, generator=generator, dtype=x.dtype) / before**0.5
        weights += [matrix * (layer < 2), x.new_zeros(after)]
    return Network([weight.requires_grad_() for weight in weights], mean, deviation, size)


def neural_rate(problem: Problem, network: Network, parameters: Tensor) -> Rate:
    """The simulation's rates with the perceptron's correction."""
    known = rate_of(problem.case.system, parameters)
    (first, a), (second, b), (last, c) = network.layers()
    into = torch.eye(len(problem.case.system.states), dtype=parameters.dtype)[:, problem.targets]
    last, c = into @ last, into @ c

    def rate(x: Tensor, u: Tensor) -> Tensor:
        hidden = torch.tanh(linear(problem.with_drives(x, u), first, a))
        return known(x, u) + linear(torch.tanh(linear(hidden, second, b)), last, c)

    return rate


def trained(
    problem: Problem, runs: Runs, length: int, epochs: int, check: Callable[[int, Rate], None], seed: int
) -> Rate:
    """A neural ODE by multiple shooting over windows of so many steps.

    Args:
        problem: the case; its fitted parameters are where the simulation's start.
        runs: to learn from.
        length: of a window, in steps.
        epochs: of Adam's whole course, whose learning rate falls to zero as a cosine.
        check: given the number of epochs done and the rates so far; it may raise StopIteration.
        seed: of the first weights.
    """
    network = new_network(problem, runs, seed)
    R = runs.time.shape[1]
    cut = windows(runs, length)
    begin = problem.from_measured(runs)[:-1:length].flatten(0, 1)
    _, deviation = spread(begin.unsqueeze(0), cut.present[:1])
    scale = deviation[problem.outputs]
    moved = torch.zeros_like(begin, requires_grad=True)
    factors = torch.zeros_like(problem.fitted, requires_grad=True)
    optimiser = torch.optim.Adam([*network.weights, moved, factors], lr=RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, epochs)
    joined = (cut.present[:2].all(0)[R:]).unsqueeze(-1)

    def rate() -> Rate:
        return neural_rate(problem, network, problem.fitted * (1.0 + factors))

    for epoch in range(1, epochs + 1):
        optimiser.zero_grad()
        starts = begin + deviation * moved
        states = free_run(rate(), starts, cut)
        away = ((states[..., problem.outputs] - cut.measured) / scale)[cut.present]
        gaps = torch.where(joined, (states[-1, :-R] - starts[R:]) / deviation, 0.0)
        loss = away.square().mean() + JOINED * gaps.square().sum() / joined.sum().clamp(min=1)
        loss.backward()
        torch.nn.utils.clip_grad_norm_([*network.weights, moved, factors], 1.0)
        optimiser.step()
        schedule.step()
        if epoch % max(epochs // CHECKS, 1) == 0:
            with torch.no_grad():
                try:
                    check(epoch, rate())
                except StopIteration:
                    break
    return rate()


def neural_ode(problem: Problem, early: Problem, seed: int = 0) -> Outcome:
    """The neural ODE, its windows and epochs chosen on the held-out part of the training runs."""
    judged: dict[tuple[int, int], float] = {}
    for length in problem.physics.windows:

        def note(epoch: int, rate: Rate, length: int = length) -> None:
            judged[length, epoch] = float(early.judged(rate))

        trained(early, problem.train.until(FITTED), length, EPOCHS, note, seed)
    length, epochs = min(judged, key=lambda key: judged[key])

    def stop(epoch: int, _: Rate) -> None:
        if epoch == epochs:
            raise StopIteration

    with_all = trained(problem, problem.train, length, EPOCHS, stop, seed)
    settings = f"windows of {length} steps, {epochs} of {EPOCHS} epochs"
    with torch.no_grad():
        errors = problem.unseen(with_all)
    return Outcome(errors, "-", f"{settings}; held-out error {problem.in_unit(judged[length, epochs])}")


@dataclass(frozen=True)
class Row:
    """A case with what each method reaches on it."""

    case: Case
    plain: Outcome
    outcomes: Mapping[str, Outcome]


def compared(case: Case, methods: Sequence[str], seed: int) -> Row:
    """Run a case with the simulation and each method, and print the results as they arrive."""
    physics = PHYSICS[case.system.name]

    def result_text(outcome: Outcome) -> str:
        return " and ".join(in_unit([value], physics) for value in outcome.errors)

    (fitted, errors), seconds = timed(lambda: plain(case))
    simulated = Outcome(errors, "-", "no effects", seconds)
    print(f"{case.name}: simulation {result_text(simulated)}", flush=True)
    outcomes = {}
    if "PySINDy" in methods or "neural ODE" in methods:
        start, for_both = timed(lambda: plain(shortened(case))[0] if len(fitted) else fitted)
        problem, early = problem_of(case, fitted), problem_of(case, start)
    for method in methods:
        if method == "ours":
            outcome, seconds = timed(lambda: ours(case))
        elif method == "PySINDy":
            outcome, seconds = timed(lambda: sindy(problem, early))
        else:
            outcome, seconds = timed(lambda: neural_ode(problem, early, seed))
        if method != "ours":
            seconds += for_both + (simulated.seconds if len(fitted) else 0.0)
        outcomes[method] = replace(outcome, seconds=seconds)
        print(f"  {method}: {result_text(outcome)}; {outcome.name}; {outcome.settings}; {seconds:.0f} s", flush=True)
    return Row(case, simulated, outcomes)


def timed(call: Callable[[], T]) -> tuple[T, float]:
    """What it gives, and the processor's seconds for it."""
    started = time.process_time()
    found = call()
    return found, time.process_time() - started


def mean_of(errors: Sequence[float]) -> tuple[float, int]:
    """Mean of those that are finite, and how many are not.

    Example:
        >>> mean_of([1.0, math.inf, 3.0])
        (2.0, 1)
    """
    finite = [value for value in errors if math.isfinite(value)]
    return (sum(finite) / len(finite) if finite else math.inf), len(errors) - len(finite)


def in_unit(errors: Sequence[float], physics: Physics) -> str:
    """Return the mean error in the unit of the system, and the number of diverged runs."""
    mean, diverged = mean_of(errors)
    if len(errors) == diverged:
        return "diverged"
    return f"{mean * physics.factor:.3f} {physics.unit}" + (
        f" ({diverged} of {len(errors)} diverged)" if diverged else ""
    )


def table(rows: Sequence[Row]) -> str:
    """One line for each unseen run and method; of several balls the mean, and how often each name was found."""
    lines = ["| unseen | method | error | found | processor |", "|---|---|---:|---|---:|"]
    balls_ = [row for row in rows if row.case.system.name == "Ball"]
    groups = ([balls_] if balls_ else []) + [[row] for row in rows if row not in balls_]
    for group in groups:
        case, physics = group[0].case, PHYSICS[group[0].case.system.name]
        what = f"balls, mean of {len(group)}" if case.system.name == "Ball" else case.name
        for method in ("simulation", *group[0].outcomes):
            outcomes = [row.plain if method == "simulation" else row.outcomes[method] for row in group]
            name = outcomes[0].name if len(group) == 1 else counted([outcome.name for outcome in outcomes])
            seconds = f"{sum(outcome.seconds for outcome in outcomes):.0f} s"
            for index, test in enumerate(case.tests):
                error_ = in_unit([outcome.errors[index] for outcome in outcomes], physics)
                lines.append(f"| {what}, {test} | {method} | {error_} | {name} | {seconds} |")
    return "\n".join(lines)


def counted(names: Sequence[str]) -> str:
    """Names with how often each occurs, the most frequent first.

    Example:
        >>> counted(["drag", "nothing", "drag"])
        'drag (2), nothing (1)'
    """
    if set(names) == {"-"}:
        return "-"
    return ", ".join(f"{name} ({count})" for name, count in Counter(names).most_common())


def arguments() -> argparse.Namespace:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--data", type=Path, default=DATA, help="folder with the recordings of the four systems")
    parser.add_argument("--systems", nargs="+", choices=SYSTEMS, default=list(SYSTEMS), help="which of them")
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS), help="which baselines")
    parser.add_argument("--ours", action="store_true", help="our diagnosis too, minutes each; not of the servo")
    parser.add_argument("--servo-too", action="store_true", help="with --ours: of the servo as well, which may not end")
    parser.add_argument("--seed", type=int, default=0, help="of the neural ODE's first weights")
    return parser.parse_args()


def main() -> None:
    options = arguments()
    if "PySINDy" in options.methods and importlib.util.find_spec("pysindy") is None:
        raise SystemExit('PySINDy is not installed; `pip install "mkc-torch[examples]"`, or --methods "neural ODE".')
    rows = []
    for system in options.systems:
        try:
            cases = SYSTEMS[system](options.data)
        except FileNotFoundError as error:
            raise SystemExit(str(error)) from None
        own = ["ours"] if options.ours and (system != "servo" or options.servo_too) else []
        rows += [compared(case, options.methods + own, options.seed) for case in cases]
    print(table(rows))


if __name__ == "__main__":
    main()
