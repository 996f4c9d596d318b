"""A batch of nonlinear problems with one leading dimension, and its residuals and derivatives at given parameters."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor
from torch.utils._pytree import tree_map

from mkc_torch._support.arguments import refuse_other_type
from mkc_torch._support.forward_mode import Residual, forward_tangents, reverse_tangents, twice_reverse_tangents

if TYPE_CHECKING:
    from jaxtyping import Float

TANGENTS: dict[str, Callable[[Residual], Residual]] = {
    "forward": forward_tangents,
    "reverse": reverse_tangents,
    "reverse twice": twice_reverse_tangents,
}
"""Methods to compute a Jacobian, by name."""

Constraint = Callable[[Tensor], Tensor]

NONLINEAR = 0.03
"""A new Jacobian is computed if the last one mispredicted at least this share of a step's change of the residuals."""

TRUST = 0.1
"""The objective's curvature is used if it is at least this share of the majoriser's in every direction."""


@dataclass(frozen=True)
class Problem:
    """B problems: their residual function, data, prior and constraints.

    Attributes:
        function: parameters (p,), and data if there are any, to residuals (N, m).
        data: tensors with leading dimension B, or None.
        batch: the user's batch dimensions, whose product is B.
        jacobian: a name in ``TANGENTS``.
        weight, used: weights of the residuals, and which residuals are used; None for all.
        prior_mean, prior_precision: of the parameters.
        box: lower and upper bounds of the parameters, (p,) each.
        equality, inequality: functions of the parameters that are 0, or at most 0.
        is_inequality: which of the k constraints are inequalities, (k,); None without constraints.
    """

    function: Residual
    data: Any
    batch: torch.Size
    jacobian: str
    weight: Tensor | None = None
    used: Tensor | None = None
    prior_mean: Tensor | None = None
    prior_precision: Tensor | None = None
    box: tuple[Tensor, Tensor] | None = None
    equality: Constraint | None = None
    inequality: Constraint | None = None
    is_inequality: Tensor | None = None

    def _over_batch(self, function: Callable[..., Tensor], theta: Tensor) -> Tensor:
        arguments = (theta,) if self.data is None else (theta, self.data)
        if theta.shape[0] == 1:
            found = function(*tree_map(lambda t: t[0], arguments))
            refuse_other_type("residual", found, Tensor, "a function that returns a tensor", "return a tensor")
            return found.unsqueeze(0)
        return torch.func.vmap(function)(*arguments)

    def raw_residual(self, theta: Float[Tensor, "B p"]) -> Float[Tensor, "B N m"]:
        return self._over_batch(self.function, theta)

    def residual(self, theta: Float[Tensor, "B p"]) -> Float[Tensor, "B N m"]:
        residual = self.raw_residual(theta)
        return residual if self.used is None else torch.where(self.used, residual, 0.0)

    def tangents(self, theta: Float[Tensor, "B p"], values: int) -> Float[Tensor, "B p N*m"]:
        """The transposed Jacobian, a row per parameter; ``values`` is B N m.

        A function may have its own method ``tangents``, which returns the rows of one problem, (p, N, m), or None.
        """
        own = getattr(self.function, "tangents", None)
        if own is not None and len(theta) == 1 and self.data is None:
            known: Tensor | None = own(theta[0])
            if known is not None and bool(known.isfinite().all()):
                return self._counted(known.unsqueeze(0))
        # reverse mode over reverse mode does not support vmap over a batch
        way = "forward" if self.jacobian == "reverse twice" and len(theta) > 1 else self.jacobian
        function = forward_tangents(self.function, values) if way == "forward" else TANGENTS[way](self.function)
        return self._counted(self._over_batch(function, theta))

    def _counted(self, rows: Float[Tensor, "B p N m"]) -> Float[Tensor, "B p N*m"]:
        """Rows of the transposed Jacobian, 0 where a residual is not used."""
        return (rows if self.used is None else torch.where(self.used.unsqueeze(1), rows, 0.0)).flatten(2)

    def _constraints(self, theta: Tensor) -> Tensor:
        """Equalities and inequalities of one problem, (k,)."""
        return torch.cat([c(theta) for c in (self.equality, self.inequality) if c is not None])

    def constraints(self, theta: Float[Tensor, "B p"]) -> Float[Tensor, "B k"] | None:
        return None if self.is_inequality is None else replace(self, data=None)._over_batch(self._constraints, theta)

    def normals(self, theta: Float[Tensor, "B p"]) -> Float[Tensor, "B k p"] | None:
        if self.is_inequality is None:
            return None
        return replace(self, data=None)._over_batch(torch.func.jacrev(self._constraints), theta)

    def at(self, theta: Float[Tensor, "B p"]) -> ProblemPoint:
        residual = self.residual(theta)
        tangents = self.tangents(theta, residual.numel())
        return ProblemPoint(theta, residual, tangents, self.constraints(theta), self.normals(theta))

    def refreshed(self, point: ProblemPoint) -> ProblemPoint:
        """The point with derivatives recomputed at its parameters if they are stale."""
        if not point.stale:
            return point
        tangents = self.tangents(point.theta, point.residual.numel())
        return replace(point, tangents=tangents, normals=self.normals(point.theta), stale=False)

    def select(self, index: Tensor) -> Problem:
        def take(value: Tensor | None) -> Tensor | None:
            return None if value is None else value[index]

        return replace(
            self,
            data=None if self.data is None else tree_map(lambda t: t[index], self.data),
            weight=take(self.weight),
            used=take(self.used),
        )

    def restore(self, value: Tensor) -> Tensor:
        return value.reshape((*self.batch, *value.shape[1:]))


@dataclass(frozen=True)
class ProblemPoint:
    """Residuals, constraints and their derivatives at parameters ``theta``.

    ``stale`` derivatives are those of a nearby point.
    """

    theta: Float[Tensor, "B p"]
    residual: Float[Tensor, "B N m"]
    tangents: Float[Tensor, "B p N*m"]
    constraint: Float[Tensor, "B k"] | None = None
    normals: Float[Tensor, "B k p"] | None = None
    stale: bool = False

    def moved(self, accept: Tensor, theta: Tensor, residual: Tensor, constraint: Tensor | None) -> ProblemPoint:
        return replace(
            self,
            theta=torch.where(accept[:, None], theta, self.theta),
            residual=torch.where(accept[:, None, None], residual, self.residual),
            constraint=None
            if constraint is None or self.constraint is None
            else torch.where(accept[:, None], constraint, self.constraint),
            stale=True,
        )

    def select(self, index: Tensor) -> ProblemPoint:
        return ProblemPoint(
            self.theta[index],
            self.residual[index],
            self.tangents[index],
            None if self.constraint is None else self.constraint[index],
            None if self.normals is None else self.normals[index],
            self.stale,
        )

    def write(self, index: Tensor, part: ProblemPoint) -> ProblemPoint:
        def merged(whole: Tensor | None, some: Tensor | None) -> Tensor | None:
            return None if whole is None or some is None else whole.index_copy(0, index, some)

        return ProblemPoint(
            self.theta.index_copy(0, index, part.theta),
            self.residual.index_copy(0, index, part.residual),
            self.tangents.index_copy(0, index, part.tangents),
            merged(self.constraint, part.constraint),
            merged(self.normals, part.normals),
            self.stale or part.stale,
        )


@dataclass(frozen=True)
class Descent:
    """End of a descent at fixed σ and d."""

    point: ProblemPoint
    value: Tensor
    converged: Tensor  # converged: actual and predicted decrease, with fresh derivatives, are below the limit
    needs_refresh: bool  # the derivatives are too stale to continue
    damping: Tensor
    n_iter: int


def kernel_weights(residual: Tensor, kappa: Tensor, d: Tensor) -> Tensor:
    """Weights exp(-κ e² / (2 d²)) of the residuals."""
    return torch.exp((-0.5 * kappa / d.square()).unsqueeze(-2) * residual.square())


def shaped_jacobian(problem: Problem, point: ProblemPoint) -> Tensor:
    """The Jacobian in the user's batch dimensions, (*, N, m, p)."""
    return problem.restore(point.tangents.unflatten(-1, point.residual.shape[1:]).movedim(1, -1))
