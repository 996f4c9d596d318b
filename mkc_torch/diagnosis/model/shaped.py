"""Joint fits that include numbers of the effects' shapes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from mkc_torch.diagnosis.model.fit import FittedModel, fitted
from mkc_torch.diagnosis.model.grid import reach_of
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.nonlinear import NoFitError
from mkc_torch.simulation.ports import Change, Nearby

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["ShapedModel", "shape_fitted"]


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


def shape_fitted(fit: FittedModel) -> FittedModel:
    """Refit with the shape numbers free.

    Args:
        fit: at the most likely parameters for its present shapes.

    Returns:
        The fit at the most likely shapes; the same fit if no number can be fitted, or no result is more likely.
    """
    model = ShapedModel.of(fit.model)
    if model.size == model.joint:
        return fit
    try:
        both = fitted(model, model.start(fit.parameters), fit.bound, graduate=False)
        terms = [_with_plain_shape(term) for term in model.shaped(both.parameters)]
        moved = JointModel(model.prepared, terms, both.model.near)
        again = fitted(moved, both.parameters[: model.joint], fit.bound, graduate=False)
    except NoFitError:
        return fit
    return again if again.log_likelihood > fit.log_likelihood else fit


def _with_plain_shape(term: Term) -> Term:
    """Return the term with plain numbers as its shape."""
    return replace(term, shape={name: float(value) for name, value in term.shape.items()})
