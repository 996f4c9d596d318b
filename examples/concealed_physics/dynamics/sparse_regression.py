"""PySINDy's model of a case, its settings chosen on the held-out part of the training runs.

PySINDy: de Silva et al., JOSS 5(49), 2104 (2020); Kaptanoglu et al., JOSS 7(69), 3994 (2022). Thresholded least
squares: Brunton, Proctor & Kutz, PNAS 113(15), 3932 (2016).
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from free_run import Rate, Runs, as_array, rate_of
from library import Physics, Shape
from problem import FITTED, Outcome, Problem
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Float

THRESHOLDS = (0.0, 0.003, 0.01, 0.03, 0.06, 0.1, 0.2, 0.4)
"""Smallest share of a rate's norm for which a term is kept."""

RIDGES = (1e-6, 0.05)
"""Ridge penalties of the regression; the second is PySINDy's default."""

ORDERS = (2, 4, 8, 16)
"""Orders of the finite differences."""

SMOOTHED_OVER = (5, 9, 15, 25, 51, 101)
"""Window lengths of the Savitzky-Golay filter, in samples."""

WIDTHS = (0.3, 0.1)
"""Widths of the smoothed sign, as shares of the typical speed."""

PLACES = (0.65, 0.9)
"""Positions of the stops, as shares of the largest deflection."""

NEARLY = 1.05
"""The candidate with the fewest terms is chosen among those with a held-out error within this factor of the least."""


@dataclass(frozen=True)
class Setting:
    """Settings of PySINDy.

    ``corrects`` states whether the terms are added to the simulation's rates. ``width`` and ``place`` are those of
    :func:`shape_of`.
    """

    differentiation: str
    corrects: bool
    threshold: float
    ridge: float
    width: float
    place: float


@dataclass(frozen=True)
class Sparse:
    """A sparse model: coefficients (terms, states), added to the rates of the simulation with parameters ``base``."""

    setting: Setting
    shape: Shape
    base: Float[Tensor, " p"]
    coefficients: Float[Tensor, "T n"]


def differentiations() -> dict[str, Any]:
    """Return PySINDy's differentiation methods by name."""
    from pysindy import FiniteDifference, SmoothedFiniteDifference

    plain = {f"differences of order {o}": FiniteDifference(order=o, drop_endpoints=True) for o in ORDERS}
    return plain | {
        f"Savitzky-Golay over {w}": SmoothedFiniteDifference(smoother_kws={"window_length": w, "polyorder": 3})
        for w in SMOOTHED_OVER
    }


def differentiated(method: Any, problem: Problem, runs: Runs) -> tuple[Tensor, Tensor, Tensor]:
    """Return states (S, n), unknown rates (S, t) and inputs (S, u) of all samples with a derivative."""
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
    """Return the coefficients by PySINDy's STLSQ; each term kept has at least the threshold's share of the norm."""
    from pysindy import STLSQ

    norm = rate.norm()
    reached = terms.abs().amax(0) > 0  # the runs may never touch a stop
    regression = STLSQ(threshold=threshold, alpha=ridge, normalize_columns=True)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Sparsity parameter is too big")
        regression.fit(as_array(terms[:, reached]), as_array(rate / norm).reshape(-1, 1))
    coefficients = terms.new_zeros(terms.shape[1])
    coefficients[reached] = torch.from_numpy(np.asarray(regression.coef_)[0]) * norm
    return coefficients


def sparse_candidates(problem: Problem, runs: Runs, settings: Sequence[Setting]) -> list[Sparse]:
    """Return a model for each setting; settings that need more samples than the shortest run are skipped."""
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
    """Return the least number of samples for a differentiation method that is applied twice.

    Example:
        >>> samples_needed("Savitzky-Golay over 25"), samples_needed("differences of order 8")
        (26, 26)
    """
    size = int(differentiation.split()[-1])
    return size + 1 if "over" in differentiation else 2 * size + 10


def shape_of(x: Float[Tensor, "S n"], setting: Setting) -> Shape:
    """Return the shape, from the typical speed and the largest deflection."""
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
    """Return all settings to try."""
    widths, places = (WIDTHS, PLACES) if physics.shapes else (WIDTHS[:1], PLACES[:1])
    methods = [f"differences of order {o}" for o in ORDERS] + [f"Savitzky-Golay over {w}" for w in SMOOTHED_OVER]
    bases = (False, True) if any(physics.own.values()) else (False,)
    return [Setting(*item) for item in product(methods, bases, THRESHOLDS, RIDGES, widths, places)]


def term_names(problem: Problem) -> list[str]:
    """Return the names of the library's terms, in the order of the coefficients."""
    system = problem.case.system
    nothing = (problem.fitted.new_zeros(1, len(names)) for names in (system.states, system.inputs))
    return list(problem.physics.terms(*problem.names(*nothing), Shape()))


def equations(problem: Problem, model: Sparse, *, numbers: bool = False) -> str:
    """Format the model's equations; terms that the simulation does not have stand between stars."""
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
    """Return PySINDy's result, with settings chosen on the held-out part of the training runs.

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
    # a model fitted to all runs may diverge on them; then the model of their first part is used
    of, model = min(both, key=lambda item: item[0].seen(single(sparse_rate(item[0], [item[1]]))))
    settings = (
        f"{setting.differentiation}, threshold {setting.threshold:g}, ridge {setting.ridge:g}"
        + (f", width {setting.width:g}, stops at {setting.place:g}" if problem.physics.shapes else "")
        + (", fitted to the first part alone" if model is tried[index] else "")
        + f"; {len(tried)} tried, held-out error {problem.in_unit(errors[index])}; "
        + equations(of, model, numbers=True)
    )
    return Outcome(of.unseen(single(sparse_rate(of, [model]))), equations(of, model), settings)
