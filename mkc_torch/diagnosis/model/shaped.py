"""Numbers of effects' shapes fitted together with all else, once the effects are known."""

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
from mkc_torch.simulation.protocol import Change, Nearby

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["ShapedModel", "shape_fitted"]


class ShapedModel(JointModel):
    """A joint model that has numbers of its effects' shapes as its last parameters, of positive ones the logarithms.

    Args:
        model: the joint model.
        reach: of each effect, the name of each such number to its least and greatest value.
    """

    def __init__(self, model: JointModel, reach: Sequence[Mapping[str, tuple[float, float]]]) -> None:
        super().__init__(model.prepared, model.terms, model.near)
        self._reach = tuple(reach)
        least = [low for one in reach for low, _ in one.values()]
        self._positive = torch.tensor([low > 0.0 for low in least], dtype=torch.bool)

    @classmethod
    def of(cls, model: JointModel) -> ShapedModel:
        """With all numbers that can be fitted."""
        return cls(model, [reach_of(term, model.prepared) for term in model.terms])

    @property
    def joint(self) -> int:
        """Number of parameters without the shapes' numbers."""
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
        """The joint model's parameters with its effects' shapes beside them."""
        values = [term.shape[name] for term, reach in zip(self.terms, self._reach, strict=True) for name in reach]
        return torch.cat([parameters, self._free(parameters.new_tensor(values))])

    def per_effect(self, values: Sequence[Any]) -> list[dict[str, Any]]:
        """Values of the numbers, by the names that they have in each effect's shape."""
        left = iter(values)
        return [{name: next(left) for name in reach} for reach in self._reach]

    def shaped(self, parameters: Float[Tensor, " p"]) -> tuple[Term, ...]:
        """The effects with these shapes; as tensors what is fitted of them, to be differentiated."""
        free = parameters[self.joint :]
        values = torch.where(self._positive, torch.where(self._positive, free, 0.0).exp(), free)
        fitted = self.per_effect(values.unbind())
        return tuple(replace(t, shape={**t.shape, **new}) for t, new in zip(self.terms, fitted, strict=True))

    def spread(self, values: Sequence[float], errors: Float[Tensor, " s"]) -> Float[Tensor, " s"]:
        """Standard errors of numbers of the shapes, from those of the parameters that stand for them."""
        return torch.where(self._positive, errors * errors.new_tensor(values), errors)

    def _free(self, values: Float[Tensor, "*a s"]) -> Float[Tensor, "*a s"]:
        return torch.where(self._positive, torch.where(self._positive, values, 1.0).log(), values)

    def changes(self, parameters: Float[Tensor, " p"]) -> dict[str, Change]:
        return JointModel(self.prepared, self.shaped(parameters)).changes(parameters[: self.joint])

    def begun_with(self, near: Nearby | None) -> ShapedModel:
        return ShapedModel(JointModel(self.prepared, self.terms, near), self._reach)


def shape_fitted(fit: FittedModel) -> FittedModel:
    """The fit with its effects' shapes at the likeliest values of the numbers that can be fitted.

    Args:
        fit: at the likeliest parameters for the shapes that it has.

    Returns:
        A fit at those shapes; the same one where no number can be fitted, or the simulation gives none that is
        likelier.
    """
    model = ShapedModel.of(fit.model)
    if model.size == model.joint:
        return fit
    try:
        both = fitted(model, model.start(fit.parameters), fit.bound, graduate=False)
        terms = [_told(term) for term in model.shaped(both.parameters)]
        moved = JointModel(model.prepared, terms, both.model.near)
        again = fitted(moved, both.parameters[: model.joint], fit.bound, graduate=False)
    except NoFitError:
        return fit
    return again if again.log_likelihood > fit.log_likelihood else fit


def _told(term: Term) -> Term:
    """The same with plain numbers as its shape."""
    return replace(term, shape={name: float(value) for name, value in term.shape.items()})
