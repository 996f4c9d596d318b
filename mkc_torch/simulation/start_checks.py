"""Checks of a simulation's parameters with a recording, at the start of the fit and before any search."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING, Literal

import torch
from torch import Tensor

from mkc_torch.simulation.parameter import Parameter

if TYPE_CHECKING:
    from jaxtyping import Float

_NOTHING = 1e-9
"""Change of the outputs, as a share of their variation, below which a parameter that doubles changes nothing."""

_TOGETHER = 0.98
"""Absolute correlation of two estimates from which only a combination of them counts as determined. Judgement."""

_JITTER = 1e-7
"""Share of the largest singular value at which smaller ones are limited."""

_COLLINEAR = 0.9999
"""The same with all other parameters of the equations known: these two alone act only together. Judgement."""

_SINGLE = 0.02
"""Largest share of a second undetermined direction's variance in the first's with which quotients are named."""

_MOVED = 0.3
"""Relative change of a parameter by which a product is distinguished from a sum."""

_WHOLE = 0.1
"""Largest difference of an exponent from a whole number, or from one half, with which it is written as that."""

_FROM_BOUND = 0.02
"""Distance from a bound to which a start there is moved, as a share of the range between two bounds."""

_FROM_ONE_BOUND = 0.1
"""The same for a single bound, as a share of the start value."""

_OF_VARIATION = 0.1
"""The same for a single bound at 0: change of the outputs, as a share of their variation."""


@dataclass(frozen=True)
class StartCheck:
    """What a check of the simulation's own parameters shows before the search.

    Attributes:
        kind: "no equation", a parameter that no rate and no output uses; "no output", a parameter that changes no
            output in this recording; "only together", parameters of which only a combination is determined;
            "at a bound", a start value at a bound, from which a fit can stall; "impossible value", a value of the fit
            without effects that cannot be; "unlikely value", a value of that fit far from the value given;
            "diverges", an output that is not finite with the given values.
        parameters: their names.
        sentence: for the user.
        combination: the determined combination, such as ``gain * inertia``; empty for other kinds.
        correlation: of the two estimates; None for other kinds.
        start: the start value that replaces one at a bound, or the nominal value of an impossible one; None for other
            kinds.
    """

    kind: Literal[
        "no equation", "no output", "only together", "at a bound", "impossible value", "unlikely value", "diverges"
    ]
    parameters: tuple[str, ...]
    sentence: str
    combination: str = ""
    correlation: float | None = None
    start: float | None = None


@dataclass(frozen=True)
class Sensitivity:
    """Derivatives of the residual at the start of a fit.

    Attributes:
        theta: (p,), the start.
        size: (p,), typical sizes of the parameters.
        tangents: (N, m, p), derivatives of the residual by the parameters.
        variation: (m,), standard deviations of the outputs.
    """

    theta: Float[Tensor, " p"]
    size: Float[Tensor, " p"]
    tangents: Float[Tensor, "N m p"]
    variation: Float[Tensor, " m"]

    @property
    def relative(self) -> Float[Tensor, "N*m p"]:
        """Derivatives by relative changes of the parameters, in standard deviations of the outputs."""
        scale = self.variation.clamp(min=torch.finfo(self.variation.dtype).tiny)
        return (self.tangents * self.size / scale.unsqueeze(-1)).flatten(0, 1)


def parameter_checks(
    at: Sensitivity,
    known: Sequence[str],
    residual: Callable[[Float[Tensor, " p"]], Float[Tensor, "N m"]],
    used: Callable[[int], bool],
) -> tuple[StartCheck, ...]:
    """Return the checks of the leading parameters, those of the equations.

    Args:
        at: derivatives at the start.
        known: names of the equations' parameters, the first of all.
        residual: of all parameters, to distinguish a product from a sum.
        used: whether a rate or an output depends on the parameter of this number.

    Example:
        A gain and an inertia of which only the quotient acts:

        >>> x = torch.linspace(0.0, 1.0, 20, dtype=torch.float64).unsqueeze(-1)
        >>> theta = torch.tensor([2.0, 4.0], dtype=torch.float64)
        >>> residual = lambda values: values[0] / values[1] * x
        >>> tangents = torch.stack([x / 4.0, -x / 8.0], -1)
        >>> found = parameter_checks(Sensitivity(theta, theta, tangents, x.std(0)), ["gain", "inertia"], residual, bool)
        >>> found[0].combination, found[0].sentence
        ('gain / inertia', 'Only `gain / inertia` is determined: the estimates of `gain` and `inertia` have ...')
    """
    if not bool(at.tangents.isfinite().all()) or not known:
        return ()
    columns = at.relative
    idle = (torch.linalg.vector_norm(columns, dim=0) / math.sqrt(max(len(columns), 1)) < _NOTHING).tolist()
    found = [_idle(name, used=used(number)) for number, name in enumerate(known) if idle[number]]
    acting = [number for number in range(columns.shape[1]) if not idle[number]]
    return (*found, *_together_checks(at, acting, known, residual))


def _idle(name: str, *, used: bool) -> StartCheck:
    if used:
        text = f"`{name}` changes no output in this recording, so its value stays as given. Excite it, or remove it."
        return StartCheck("no output", (name,), text)
    text = f"`{name}` is in no equation: no rate and no output depends on it. Use it in the simulation, or remove it."
    return StartCheck("no equation", (name,), text)


def _together_checks(
    at: Sensitivity, acting: Sequence[int], known: Sequence[str], residual: Callable[[Tensor], Tensor]
) -> list[StartCheck]:
    """Return the parameters that act only together: collinear pairs, then groups with correlated estimates.

    Of a collinear pair the second stays as it is for the checks that follow.
    """
    columns, found = at.relative, []
    free = list(acting)
    others = [number for number in free if number >= len(known)]
    for a, b in combinations([number for number in acting if number < len(known)], 2):
        if a in free and b in free:
            covariance, correlation = _estimates(columns, [a, b, *others])
            if abs(float(correlation[0, 1])) > _COLLINEAR:
                determined = torch.linalg.eigh(covariance[:2, :2]).eigenvectors[:, 0]
                text = _combination(at, (a, b), known, determined, residual)
                found.append(_check((known[a], known[b]), text, float(correlation[0, 1])))
                free.remove(b)
    own = [place for place, number in enumerate(free) if number < len(known)]
    covariance, correlation = _estimates(columns, free)
    for group in _groups(correlation, own):
        names = tuple(known[free[place]] for place in group)
        values, directions = torch.linalg.eigh(covariance[group][:, group])
        if len(group) == 2:
            text = _combination(at, (free[group[0]], free[group[1]]), known, directions[:, 0], residual)
        else:
            text = _quotients(names, directions[:, -1]) if values[-2] < _SINGLE * values[-1] else ""
        strongest = correlation[group][:, group] - torch.eye(len(group), dtype=correlation.dtype)
        found.append(_check(names, text, float(strongest.flatten()[strongest.abs().argmax()])))
    return found


def _estimates(
    columns: Float[Tensor, "R p"], numbers: Sequence[int]
) -> tuple[Float[Tensor, "q q"], Float[Tensor, "q q"]]:
    """Return covariance and correlation of the estimates of some parameters under white noise, all others known."""
    chosen = columns[:, list(numbers)]
    scale = torch.linalg.vector_norm(chosen, dim=0).clamp(min=1e-300)
    _, length, directions = torch.linalg.svd(torch.linalg.qr(chosen / scale, mode="r").R)
    inverse = directions.mT / length.clamp(min=_JITTER * float(length.amax()))
    covariance = (inverse @ inverse.mT) / (scale.unsqueeze(-1) * scale)
    error = covariance.diagonal().sqrt()
    return covariance, covariance / (error.unsqueeze(-1) * error)


def _groups(correlation: Float[Tensor, "q q"], places: Sequence[int]) -> list[list[int]]:
    """Return the groups of places that high correlations connect.

    Example:
        >>> _groups(torch.tensor([[1.0, 0.99, 0.2], [0.99, 1.0, 0.1], [0.2, 0.1, 1.0]]), [0, 1, 2])
        [[0, 1]]
    """
    group = {place: [place] for place in places}
    for a, b in combinations(places, 2):
        if abs(float(correlation[a, b])) > _TOGETHER and group[a] is not group[b]:
            group[a].extend(group[b])
            group.update(dict.fromkeys(group[b], group[a]))
    return [sorted(members) for place, members in group.items() if len(members) > 1 and place == min(members)]


def _quotients(names: Sequence[str], direction: Float[Tensor, " k"]) -> str:
    """Write the quotients that stay constant along an undetermined direction of relative changes."""
    lead = int(direction.abs().argmax())
    shares = [float(share / direction[lead]) for share in direction]
    parts = [
        f"{name} {'/' if share > 0 else '*'} {_power(names[lead], abs(share))}"
        for name, share in zip(names, shares, strict=True)
        if name != names[lead] and abs(share) > _WHOLE
    ]
    return ", ".join(parts)


def _check(names: tuple[str, ...], combination: str, correlation: float) -> StartCheck:
    listed = f"{', '.join(f'`{name}`' for name in names[:-1])} and `{names[-1]}`"
    only = ", ".join(f"`{part}`" for part in combination.split(", "))
    text = (
        (f"Only {only} {'are' if ',' in combination else 'is'} determined: the" if combination else "The")
        + f" estimates of {listed} have a correlation of {correlation:.3f} in this recording. Fix one of them, or "
        "record with more different inputs."
    )
    return StartCheck("only together", names, text, combination, correlation)


def _combination(
    at: Sensitivity,
    places: tuple[int, int],
    known: Sequence[str],
    weights: Float[Tensor, " 2"],
    residual: Callable[[Tensor], Tensor],
) -> str:
    """Write the determined combination as a product, a quotient or a sum, whichever moves the residual less."""
    lead = int(float(weights[1].abs()) > (1.0 + _WHOLE) * float(weights[0].abs()))
    first, second = places[lead], places[1 - lead]
    share = float(weights[1 - lead] / weights[lead])  # of a relative change of the second in one of the first
    theta = at.theta
    names = known[first], known[second]
    per_unit = share * float(at.size[first] / at.size[second])
    product, sum_ = theta.clone(), theta.clone()
    # along the undetermined direction, where the combination is constant
    product[second] = product[second] * (1.0 + _MOVED)
    product[first] = product[first] * (1.0 + _MOVED) ** (-share)
    sum_[second] += _MOVED * at.size[second]
    sum_[first] -= _MOVED * share * at.size[first]
    start = residual(theta)
    moved = [float((residual(values) - start).square().mean().nan_to_num(math.inf)) for values in (product, sum_)]
    if bool((theta[list(places)] == 0).any()) or moved[1] < 0.5 * moved[0] - _NOTHING**2:
        return f"{names[0]} {'+' if per_unit > 0 else '-'} {abs(per_unit):.3g} {names[1]}"
    sign = "*" if share > 0 else "/"
    return f"{names[0]} {sign} {_power(names[1], abs(share))}"


def _power(name: str, exponent: float) -> str:
    if abs(exponent - 1.0) <= _WHOLE:
        return name
    return f"sqrt({name})" if abs(exponent - 0.5) <= 0.5 * _WHOLE else f"{name}^{exponent:.2g}"


def moved_inside(known: Sequence[Parameter], tangents: Callable[[], Sensitivity]) -> dict[int, float]:
    """Return start values that replace those at a bound, by the number of the parameter.

    Args:
        known: the parameters; one with equal bounds is fixed and stays.
        tangents: called if a parameter starts at 0 and has a single bound there.

    Example:
        >>> moved_inside([Parameter(1.0, lower=1.0, upper=3.0), Parameter(2.0)], lambda: None)
        {0: 1.04}
    """
    found = {}
    for number, parameter in enumerate(known):
        low, high, value = parameter.lower, parameter.upper, parameter.value
        if low == high or value not in (low, high):
            continue
        if math.isfinite(low) and math.isfinite(high):
            step = _FROM_BOUND * (high - low)
        elif value != 0.0:
            step = _FROM_ONE_BOUND * abs(value)
        else:
            step = _visible_step(tangents(), number)
        if step > 0.0:
            found[number] = value + step if value == low else value - step
    return found


def _visible_step(at: Sensitivity, number: int) -> float:
    """Return the step of a parameter that changes the outputs visibly; 0 for a parameter without an effect."""
    scale = at.variation.clamp(min=torch.finfo(at.variation.dtype).tiny)
    effect = float((at.tangents[..., number] / scale).square().mean().sqrt())
    return _OF_VARIATION / effect if 0.0 < effect < math.inf else 0.0


def bound_checks(names: Sequence[str], known: Sequence[Parameter], moved: dict[int, float]) -> tuple[StartCheck, ...]:
    """Return a check for each start value that was moved inside its bounds.

    Example:
        >>> bound_checks(["drag"], [Parameter(0.0, lower=0.0)], {0: 0.01})[0].sentence
        '`drag` starts at its bound 0, from which a fit can stall: the fit starts at 0.01 instead.'
    """
    return tuple(
        StartCheck(
            "at a bound",
            (names[number],),
            f"`{names[number]}` starts at its bound {known[number].value:g}, from which a fit can stall: the fit "
            f"starts at {start:.4g} instead.",
            start=start,
        )
        for number, start in moved.items()
    )
