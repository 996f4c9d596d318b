"""Numbers of an effect's shape fitted together with all else, once the effect is known."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from mkc_torch.diagnosis.candidates import reach_of
from mkc_torch.diagnosis.model import JointModel
from mkc_torch.diagnosis.refit import FittedModel, fitted
from mkc_torch.effects.protocol import Shape
from mkc_torch.simulation.protocol import Change

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["shape_fitted"]


class ShapedModel(JointModel):
    """A joint model that has, as its last parameters, the logarithms of numbers in its last effect's shape.

    Args:
        model: the joint model.
        reach: name of each number to its least and greatest value, positive.
    """

    def __init__(self, model: JointModel, reach: Mapping[str, tuple[float, float]]) -> None:
        super().__init__(model.prepared, model.terms)
        self._reach = dict(reach)

    @property
    def size(self) -> int:
        return super().size + len(self._reach)

    @property
    def bounds(self) -> tuple[Float[Tensor, " p"], Float[Tensor, " p"]]:
        shapes = self.prepared.time.new_tensor(list(self._reach.values())).log()
        known = super().bounds
        if known is None:
            free = shapes.new_full((super().size,), torch.inf)
            known = -free, free
        return torch.cat([known[0], shapes[:, 0]]), torch.cat([known[1], shapes[:, 1]])

    def start(self, parameters: Float[Tensor, " q"]) -> Float[Tensor, " p"]:
        """The joint model's parameters with its last effect's shape beside them."""
        shape = self.terms[-1].shape
        return torch.cat([parameters, parameters.new_tensor([shape[name] for name in self._reach]).log()])

    def shape(self, parameters: Float[Tensor, " p"]) -> Shape:
        """The last effect's shape; what is fitted of it as tensors, to be differentiated."""
        values: tuple[Any, ...] = parameters[-len(self._reach) :].exp().unbind()
        return {**self.terms[-1].shape, **dict(zip(self._reach, values, strict=True))}

    def changes(self, parameters: Float[Tensor, " p"]) -> dict[str, Change]:
        return self.with_shape(self.shape(parameters)).changes(parameters[: -len(self._reach)])


def shape_fitted(fit: FittedModel) -> FittedModel:
    """The fit with its last effect's shape at the likeliest values of the numbers that can be fitted.

    Args:
        fit: at the likeliest parameters for the shape that it has.

    Returns:
        A fit at that shape; the same one where no number can be fitted, or the simulation gives none that is likelier.
    """
    reach = reach_of(fit.model.terms[-1], fit.model.prepared)
    if not reach:
        return fit
    model = ShapedModel(fit.model, reach)
    try:
        both = fitted(model, model.start(fit.parameters), fit.bound, graduate=False)
        shape = {name: float(value) for name, value in model.shape(both.parameters).items()}
        moved = fitted(fit.model.with_shape(shape), both.parameters[: fit.model.size], fit.bound, graduate=False)
    except ValueError:
        return fit
    return moved if moved.log_likelihood > fit.log_likelihood else fit
