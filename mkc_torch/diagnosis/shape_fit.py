"""Numbers of effects' shapes fitted together with all else, once the effects are known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from mkc_torch.diagnosis.candidates import reach_of
from mkc_torch.diagnosis.model import JointModel, Term
from mkc_torch.diagnosis.refit import FittedModel, fitted
from mkc_torch.simulation.protocol import Change

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["ShapedModel", "shape_fitted"]


class ShapedModel(JointModel):
    """A joint model that has, as its last parameters, the logarithms of numbers in its effects' shapes.

    Args:
        model: the joint model.
        reach: of each effect, the name of each such number to its least and greatest value, positive.
    """

    def __init__(self, model: JointModel, reach: Sequence[Mapping[str, tuple[float, float]]]) -> None:
        super().__init__(model.prepared, model.terms)
        self._reach = tuple(reach)

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
        shapes = self.prepared.time.new_tensor(ends).reshape(-1, 2).log()
        known = super().bounds
        if known is None:
            free = shapes.new_full((self.joint,), torch.inf)
            known = -free, free
        return torch.cat([known[0], shapes[:, 0]]), torch.cat([known[1], shapes[:, 1]])

    def start(self, parameters: Float[Tensor, " q"]) -> Float[Tensor, " p"]:
        """The joint model's parameters with its effects' shapes beside them."""
        values = [term.shape[name] for term, reach in zip(self.terms, self._reach, strict=True) for name in reach]
        return torch.cat([parameters, parameters.new_tensor(values).log()])

    def per_effect(self, values: Sequence[Any]) -> list[dict[str, Any]]:
        """Values of the numbers, by the names that they have in each effect's shape."""
        left = iter(values)
        return [{name: next(left) for name in reach} for reach in self._reach]

    def shaped(self, parameters: Float[Tensor, " p"]) -> tuple[Term, ...]:
        """The effects with these shapes; as tensors what is fitted of them, to be differentiated."""
        fitted = self.per_effect(parameters[self.joint :].exp().unbind())
        return tuple(replace(t, shape={**t.shape, **new}) for t, new in zip(self.terms, fitted, strict=True))

    def changes(self, parameters: Float[Tensor, " p"]) -> dict[str, Change]:
        return JointModel(self.prepared, self.shaped(parameters)).changes(parameters[: self.joint])


def shape_fitted(fit: FittedModel) -> FittedModel:
    """The fit with its last effect's shape at the likeliest values of the numbers that can be fitted.

    Args:
        fit: at the likeliest parameters for the shape that it has.

    Returns:
        A fit at that shape; the same one where no number can be fitted, or the simulation gives none that is likelier.
    """
    last = fit.model.terms[-1]
    reach = reach_of(last, fit.model.prepared)
    if not reach:
        return fit
    model = ShapedModel(fit.model, [*({} for _ in fit.model.terms[:-1]), reach])
    try:
        both = fitted(model, model.start(fit.parameters), fit.bound, graduate=False)
        shape = {name: float(value) for name, value in model.shaped(both.parameters)[-1].shape.items()}
        moved = fitted(fit.model.with_shape(shape), both.parameters[: model.joint], fit.bound, graduate=False)
    except ValueError:
        return fit
    return moved if moved.log_likelihood > fit.log_likelihood else fit
