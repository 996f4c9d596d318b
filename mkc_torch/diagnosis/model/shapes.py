"""Shapes of effects: the grid of candidates, and joint fits that include shape numbers."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import product
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from mkc_torch.diagnosis.model.fit import FULL, Effort, FittedModel, fitted
from mkc_torch.diagnosis.model.further_drivers import further_drivers
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.term import (
    INPUT,
    PAIR,
    Driver,
    Drivers,
    Term,
    find_drivers,
    input_drivers,
    run_parallel,
)
from mkc_torch.diagnosis.settings import DriverSettings
from mkc_torch.effects.base import Effect
from mkc_torch.effects.context import Shape
from mkc_torch.effects.kinds import kind_of
from mkc_torch.effects.per_recording import PerRecording, can_differ
from mkc_torch.nonlinear import NoFitError
from mkc_torch.simulation.ports import Change, Nearby, Port, SignalSizes
from mkc_torch.simulation.protocol import PreparedSimulation, Simulation

if TYPE_CHECKING:
    from jaxtyping import Float


_STEPS = 8
"""Grid points of a shape number to either side of its value, and the factor by which its range shrinks each round."""

_FACTORS = (0.5, 0.71, 0.84, 0.92, 1.09, 1.19, 1.41, 2.0)
"""Factors by which a delay or a lag is varied in each round."""

_REPEATED = 0.9
"""Absolute correlation with an input above which a column counts as that input, as in ``alike_columns``."""

_LEADING = 2
"""Number of the most likely variants whose shape is fitted in each round."""

_ROUNDS = 4
"""Largest number of rounds."""

_SETTLED_NATS = 0.5
"""Gain of a round up to which there is no further round."""


def candidates_of(
    simulation: Simulation, prepared: PreparedSimulation, effects: Sequence[Effect], settings: DriverSettings
) -> tuple[Drivers, tuple[Term, ...]]:
    """Return the drivers in a simulation's recording, and all candidates.

    Args:
        simulation: the simulation, whose own columns drive nothing.
        prepared: the simulation with the recording, in open loop.
        effects: the catalogue.
        settings: which columns are drivers.
    """
    roles = frozenset(role for effect in effects for role in effect.roles)
    found = find_drivers(prepared.recording, simulation.columns, settings, roles, simulation.measured)
    more = further_drivers(prepared, found.drivers, settings)
    terms = candidate_terms(prepared, (*found.drivers, *more), effects)
    return found, (*terms, *per_recording(terms, prepared))


def per_recording(terms: Sequence[Term], prepared: PreparedSimulation) -> tuple[Term, ...]:
    """Return the candidates that can have a size for each recording in this form; none for a single recording.

    Only for differential equations, whose search compares the forms by their score.
    """
    dynamics = prepared.dynamics
    if dynamics is None or len(dynamics.recordings) < 2:
        return ()
    forms = {
        id(term.effect): PerRecording(term.effect, dynamics.recordings, dynamics.of_run)
        for term in terms
        if can_differ(term.effect)
    }
    return tuple(replace(term, effect=forms[id(term.effect)]) for term in terms if id(term.effect) in forms)


def candidate_terms(
    prepared: PreparedSimulation, drivers: Sequence[Driver], effects: Sequence[Effect]
) -> tuple[Term, ...]:
    """Return each effect that has a port in the simulation, with each of its drivers and each shape of its grid.

    Without effects whose shape a periodogram finds.
    """
    terms = []
    inputs = input_drivers(prepared)
    own = {driver.columns for driver in drivers if not _repeats_an_input(driver, prepared)}
    own |= {driver.columns for driver in inputs}
    for effect in effects:
        places = () if effect.by_periodogram else ports_of(effect, prepared.ports)
        # an effect without roles, or with an optional driver, is also tried without a driver
        alone = not effect.roles or effect.driver_optional
        known = [*drivers, *(inputs if effect.driven_by_inputs else ())]
        fitting = [*([None] if alone else []), *(d for d in known if _drives(d, effect))]
        shapes = effect.shapes(prepared.time)
        terms += [
            Term(effect, driver, shape, "" if at == effect.port else at)
            for at in places
            for driver in fitting
            if driver is None or driver.columns in own or prepared.dynamics is None
            if driver is None or at != f"input {driver.columns[0]}"
            for shape in (absolute(effect, shape, prepared.ports[at], driver) for shape in shapes)
        ]
    return tuple(term for term in terms if not within_a_sample(term, prepared))


def _repeats_an_input(driver: Driver, prepared: PreparedSimulation) -> bool:
    """Whether a column nearly repeats an input: it would act where the input acts, and repair a wrong simulation."""
    inputs = [name.removeprefix("input ") for name, port in prepared.ports.items() if port.kind == "input"]
    table = [prepared.recording[name] for name in inputs if name in prepared.recording]
    if not table or driver.values.shape[1] != 1:
        return False
    away = torch.stack(table) - torch.stack(table).mean(-1, keepdim=True)
    away = away / torch.linalg.vector_norm(away, dim=-1, keepdim=True).clamp(min=1e-300)
    column = driver.values[:, 0] / torch.linalg.vector_norm(driver.values)
    return bool(((away @ column).abs() > _REPEATED).any())


def within_a_sample(term: Term, prepared: PreparedSimulation) -> bool:
    """Whether a candidate only changes what an input does between two samples."""
    inside = prepared.time.diff()
    step = float(inside[inside > 0].median()) if bool((inside > 0).any()) else 0.0
    return term.effect.within_a_sample(term.shape, step)


def ports_of(effect: Effect, ports: Mapping[str, Port]) -> tuple[str, ...]:
    """Return the names of the ports at which an effect acts.

    Example:
        >>> from mkc_torch.effects.dynamics.input_lag import InputLag
        >>> ports_of(
        ...     InputLag(),
        ...     {"output": Port(("x",), "m"), "input u": Port(("u",), "V", kind="input", parts={"own": "u"})},
        ... )
        ('input u',)
    """
    return tuple(
        name
        for name, port in ports.items()
        if effect.port in (name, port.kind, port.stands_for)
        and set(effect.needs) <= set(port.parts)
        and set(port.parts).isdisjoint(effect.excludes)
    )


def absolute(effect: Effect, shape: Shape, port: Port, driver: Driver | None = None) -> Shape:
    """Return a shape in units, from shares of the signal at the port or of the driver."""
    if not effect.relative:
        return shape
    known = dict(port.sizes)
    if driver is not None:
        known["driver"] = SignalSizes.of(torch.linalg.vector_norm(driver.values, dim=-1))
    sizes = {part: values._asdict() for part, values in known.items()}
    return {**shape} | {name: shape[name] * sizes[part][which] for name, (part, which) in effect.relative.items()}


def reach_of(term: Term, prepared: PreparedSimulation) -> dict[str, tuple[float, float]]:
    """Return the lower and upper limits, in units, of the numbers of a shape that are fitted together with γ.

    Raises:
        ValueError: the effect names a number that its shape does not have, or an empty range.
    """
    if not term.effect.fitted_shape:
        return {}
    port, reach = prepared.ports[term.port], term.effect.fitted_shape
    for name, (low, high) in reach.items():
        if name not in term.shape or not low < high:
            raise ValueError(
                f"Expected `fitted_shape` of {term.effect.id} to hold numbers of its shape ({', '.join(term.shape)}) "
                f"with a lower and a greater upper limit but got `{name}`: ({low}, {high}); correct it or "
                "leave it out."
            )
    of_length, length = term.effect.continuous, float(prepared.time[-1] - prepared.time[0])
    ends = [
        absolute(term.effect, {**term.shape, **{n: r[k] for n, r in reach.items()}}, port, term.driver) for k in (0, 1)
    ]
    lower, upper = ({name: end[name] * (length if name in of_length else 1.0) for name in reach} for end in ends)
    return {name: (lower[name], upper[name]) for name in reach}


def _drives(driver: Driver, effect: Effect) -> bool:
    """Whether a driver has one of an effect's roles and kinds; a curve without a name accepts any single column."""
    kinds = effect.driver_kinds
    if kinds and kind_of(driver.units[0], driver.columns[0]) not in kinds:
        return False
    if effect.positive_driver and not bool((driver.values + driver.reference >= 0.0).all()):
        return False
    any_column = bool(effect.roles) and effect.is_curve and driver.role not in (INPUT, PAIR)
    return driver.role in effect.roles or (any_column and len(driver.columns) == 1)


def finer(term: Term, name: str, time: Float[Tensor, " N"], rounds: int) -> tuple[Term, ...]:
    """Return the effect with one number of its shape varied, over 1/8 of its range either way, less in later rounds.

    Args:
        term: the effect.
        name: of the number, one of the effect's continuous numbers.
        time: of the recording.
        rounds: how often the range was narrowed before.
    """
    low, high = (share * float(time[-1] - time[0]) for share in term.effect.continuous[name])
    offset = float(time[0]) if name == "onset" else 0.0
    value = term.shape[name]
    reach = (high - low) / _STEPS ** (rounds + 1)
    values = {min(max(value + reach * k / _STEPS, low + offset), high + offset) for k in range(-_STEPS, _STEPS + 1)}
    return tuple(replace(term, shape={**term.shape, name: v}) for v in sorted(values))


def described(effect: Effect, shape: Shape) -> str:
    """Return the reported numbers of a shape as text.

    Example:
        >>> from mkc_torch.effects.sensor.offset_drift import OffsetDrift
        >>> described(OffsetDrift(), {"middle": 12.345, "width": 0.5})
        'middle 12.35 s, width 0.5 s'
    """
    numbers = {name: value for name, value in shape.items() if effect.reports(name)}
    units = {name: effect.shape_units.get(name, "") for name in numbers}
    return ", ".join(f"{name.replace('_', ' ')} {value:.4g} {units[name]}".rstrip() for name, value in numbers.items())


class ShapedModel(JointModel):
    """A joint model whose last parameters are shape numbers of its effects; positive numbers enter as logarithms.

    Args:
        model: the joint model.
        reach: for each effect, the limits (lower, upper) of each shape number by name.
    """

    def __init__(self, model: JointModel, reach: Sequence[Mapping[str, tuple[float, float]]]) -> None:
        super().__init__(model.prepared, model.terms, model.near)
        self._reach = tuple(reach)
        lower = [low for limits in reach for low, _ in limits.values()]
        self._positive = torch.tensor([low > 0.0 for low in lower], dtype=torch.bool)

    @classmethod
    def of(cls, model: JointModel) -> ShapedModel:
        """Include all shape numbers that can be fitted."""
        return cls(model, [reach_of(term, model.prepared) for term in model.terms])

    @property
    def joint(self) -> int:
        """Number of parameters without the shape numbers."""
        return super().size

    @property
    def size(self) -> int:
        return self.joint + sum(map(len, self._reach))

    @property
    def bounds(self) -> tuple[Float[Tensor, " p"], Float[Tensor, " p"]]:
        ends = [end for reach in self._reach for end in reach.values()]
        shapes = self._free(self.prepared.time.new_tensor(ends).reshape(-1, 2).mT).mT
        known = super().bounds
        if known is None:
            free = shapes.new_full((self.joint,), torch.inf)
            known = -free, free
        return torch.cat([known[0], shapes[:, 0]]), torch.cat([known[1], shapes[:, 1]])

    def start(self, parameters: Float[Tensor, " q"]) -> Float[Tensor, " p"]:
        """Return the joint model's parameters followed by the shape numbers."""
        values = [term.shape[name] for term, reach in zip(self.terms, self._reach, strict=True) for name in reach]
        return torch.cat([parameters, self._free(parameters.new_tensor(values))])

    def moved(self, parameters: Float[Tensor, " p"], number: int, value: float) -> Float[Tensor, " p"]:
        """Return the parameters with another value of a shape number, no less than its lower limit."""
        low = [low for limits in self._reach for low, _ in limits.values()][number]
        values = torch.full_like(parameters[self.joint :], max(value, low))
        chosen = torch.arange(len(values)) == number
        return torch.cat([parameters[: self.joint], torch.where(chosen, self._free(values), parameters[self.joint :])])

    def per_effect(self, values: Sequence[Any]) -> list[dict[str, Any]]:
        """Split values of the shape numbers into one mapping per effect, by name."""
        left = iter(values)
        return [{name: next(left) for name in reach} for reach in self._reach]

    def shaped(self, parameters: Float[Tensor, " p"]) -> tuple[Term, ...]:
        """Return the effects with the shapes of these parameters, as differentiable tensors."""
        free = parameters[self.joint :]
        values = torch.where(self._positive, torch.where(self._positive, free, 0.0).exp(), free)
        fitted = self.per_effect(values.unbind())
        return tuple(replace(t, shape={**t.shape, **new}) for t, new in zip(self.terms, fitted, strict=True))

    def spread(self, values: Sequence[float], errors: Float[Tensor, " s"]) -> Float[Tensor, " s"]:
        """Return standard errors of the shape numbers from those of their parameters."""
        return torch.where(self._positive, errors * errors.new_tensor(values), errors)

    def _free(self, values: Float[Tensor, "*a s"]) -> Float[Tensor, "*a s"]:
        return torch.where(self._positive, torch.where(self._positive, values, 1.0).log(), values)

    def changes(self, parameters: Float[Tensor, " p"]) -> dict[str, Change]:
        return JointModel(self.prepared, self.shaped(parameters)).changes(parameters[: self.joint])

    def begun_with(self, near: Nearby | None) -> ShapedModel:
        return ShapedModel(JointModel(self.prepared, self.terms, near), self._reach)


def shape_fitted(fit: FittedModel, effort: Effort = FULL) -> FittedModel:
    """Refit with the shape numbers free.

    Args:
        fit: at the most likely parameters for its present shapes.
        effort: how far the fit goes.

    Returns:
        The fit at the most likely shapes; the same fit if no number can be fitted, or no result is more likely.
    """
    model = ShapedModel.of(fit.model)
    if model.size == model.joint:
        return fit
    try:
        start = model.start(fit.parameters)
        both = fitted(model, start, fit.bound, graduate=False, effort=effort, squares=fit.sigma_held)
    except NoFitError:
        return fit
    if not both.log_likelihood > fit.log_likelihood:
        return fit
    terms = [_with_plain_shape(term) for term in model.shaped(both.parameters)]
    moved = JointModel(model.prepared, terms, both.model.near)
    return replace(both, model=moved, parameters=both.parameters[: model.joint])


def _with_plain_shape(term: Term) -> Term:
    """Return the term with plain numbers as its shape."""
    return replace(term, shape={name: float(value) for name, value in term.shape.items()})


def with_profiled_shape(fit: FittedModel) -> FittedModel:
    """Return the fit with the delay or lag of its last effect, on an input, at the maximum of the profile likelihood.

    A delay of an input that is held between samples changes the trajectory in steps: the likelihood has a local maximum
    near each multiple of the sample interval, at which a fit of all parameters together stops. So all other parameters
    are refitted at several delays. Effects at other ports are returned unchanged.

    Args:
        fit: with at least one effect, at its most likely parameters.
    """
    for _ in range(_ROUNDS):
        others = list(_varied(fit))
        if not others:
            return fit
        known = fit.model.prepared, [fit.model.terms[-1]]
        works = [partial(_with_terms, fit, [*fit.model.terms[:-1], term]) for term in others]
        tried = [found for found in run_parallel(works, *known) if found]
        leading = sorted(tried, key=lambda found: -found.log_likelihood)[:_LEADING]
        shaped = run_parallel([partial(shape_fitted, found) for found in leading], *known)
        best = max(shaped, key=lambda found: found.log_likelihood, default=fit)
        if not best.log_likelihood > fit.log_likelihood + _SETTLED_NATS:
            return fit
        fit = best
    return fit


Better = Callable[[FittedModel, FittedModel], bool]
"""Whether the first of two fits is the better."""


def more_likely(other: FittedModel, fit: FittedModel) -> bool:
    """Whether a fit is more likely than another by more than rounding and the end of an iteration."""
    return other.log_likelihood > fit.log_likelihood + _SETTLED_NATS


def with_form_of_grid(
    fit: FittedModel, effort: Effort = FULL, criteria: Sequence[Better] = (more_likely,), number: int = -1
) -> FittedModel:
    """Return the fit with the form of an effect, such as a width, moved along its grid while the fit gets better.

    The search chooses a form by its linearised gain, which differs little between forms, but the joint fits can differ
    by more than those of two effects: dry friction whose sign changes too slowly loses to one that falls with speed.

    Args:
        fit: with at least one effect, at its most likely parameters.
        effort: how far each fit goes.
        criteria: each compares two forms; applied one after the other.
        number: of the effect; default the last.
    """
    effect, prepared = fit.model.terms[number].effect, fit.model.prepared
    names = set(effect.form_parameters) & set(effect.relative)
    neighbours: dict[tuple[str, int], FittedModel | None] = {}
    for better, name, steps in product(criteria, sorted(names), (-1, 1)):
        port = prepared.ports[fit.model.terms[number].port]
        grid = sorted({absolute(effect, shape, port)[name] for shape in effect.shapes(prepared.time)})
        while True:
            if (name, steps) not in neighbours:
                neighbours[name, steps] = _at_next(fit, number, name, grid, steps, effort)
            moved = neighbours[name, steps]
            if moved is None or not better(moved, fit):
                break
            fit, neighbours = moved, {(name, -steps): fit}
    return fit


def _at_next(
    fit: FittedModel, number: int, name: str, grid: Sequence[float], steps: int, effort: Effort
) -> FittedModel | None:
    """Refit with the next value of a number on its grid; None at the end, and without a finite trajectory."""
    term = fit.model.terms[number]
    place = min(range(len(grid)), key=lambda k: abs(grid[k] - term.shape[name])) + steps
    if not 0 <= place < len(grid):
        return None
    terms = list(fit.model.terms)
    terms[number] = replace(term, shape={**term.shape, name: grid[place]})
    return _with_terms(fit, terms, effort)


def _varied(fit: FittedModel) -> Iterator[Term]:
    """Yield the last effect with each of its delays and lags varied, within the limits."""
    term, prepared = fit.model.terms[-1], fit.model.prepared
    if prepared.ports[term.port].kind != "input":
        return
    for name, (low, high) in reach_of(term, prepared).items():
        if name in term.effect.continuous:
            for value in sorted({min(max(factor * term.shape[name], low), high) for factor in _FACTORS}):
                yield replace(term, shape={**term.shape, name: value})


def _with_terms(fit: FittedModel, terms: Sequence[Term], effort: Effort = FULL) -> FittedModel | None:
    """Refit with other shapes of the effects; None if there is no finite trajectory."""
    model = JointModel(fit.model.prepared, terms, fit.model.near)
    try:
        return fitted(model, fit.parameters, fit.bound, graduate=False, effort=effort, squares=fit.sigma_held)
    except NoFitError:
        return None
