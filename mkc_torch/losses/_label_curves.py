"""Curves of generalized cross-entropy over the predicted probability of the label."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from mkc_torch._support.arguments import refuse_not_real, refuse_out_of_range
from mkc_torch.losses._curves import Curves

if TYPE_CHECKING:
    from jaxtyping import Float

_POINTS = 401
"""Points per curve of a picture."""


class LabelCurves(Curves):
    """Curves of a loss with a scalar ``kappa`` = 1/σ²."""

    kappa: Tensor

    def rho(self, probability: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
        """Loss of a label with predicted probability p: ``σ² (1 - p^(1/σ²))``.

        Args:
            probability: predicted probability p in [0, 1] of the label, any shape.

        Raises:
            TypeError, ValueError: not a real tensor, or out of range.

        Example:
            >>> from mkc_torch import GeneralizedCrossEntropyLoss
            >>> GeneralizedCrossEntropyLoss(sigma=1.0).rho(torch.tensor([0.0, 0.25, 1.0]))
            tensor([1.0000, 0.7500, 0.0000])
        """
        p, kappa = self._given(probability)
        deviance = 0.0 - torch.log(p)
        own = torch.where(kappa > 0, kappa, 1.0)
        return torch.where(kappa > 0, -torch.expm1(-own * deviance) / own, deviance)

    def influence(self, probability: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
        """Derivative of :meth:`rho` with respect to the probability, ``-p^(1/σ² - 1)``: -∞ at p = 0 if σ > 1."""
        p, kappa = self._given(probability)
        return -p.pow(kappa - 1.0)

    def weight_at(self, probability: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
        """Influence of a label relative to that of cross-entropy, ``p^(1/σ²)`` in [0, 1].

        The attribute ``weight`` holds the class weights, as in torch; ``inlier_weight`` takes logits and labels.

        Example:
            >>> from mkc_torch import GeneralizedCrossEntropyLoss
            >>> GeneralizedCrossEntropyLoss(sigma=0.5**0.5).weight_at(torch.tensor([0.1, 0.9]))
            tensor([0.0100, 0.8100])
        """
        p, kappa = self._given(probability)
        return p.pow(kappa)

    def plot(self, axes: Any = None) -> Any:
        """Draw value, influence and weight over the probability of the label, and return the axes; needs matplotlib.

        The influence is that on the label's logit, ``p^(1/σ²) (1 - p)``; cross-entropy's, ``1 - p``, is drawn too.

        Args:
            axes: axes of matplotlib, or None for a new figure.

        Raises:
            ModuleNotFoundError: matplotlib is not installed; the extra ``cli`` has it.
        """
        with torch.no_grad():
            p = torch.linspace(0.0, 1.0, _POINTS, dtype=torch.float64, device=self.kappa.device)
            # cross-entropy's value is infinite at 0
            value = self.rho(p) if bool(self.kappa > 0) else self.rho(p.clamp(min=1.0 / _POINTS))
            curves = {
                "value": value,
                "influence on the logit": self.weight_at(p) * (1.0 - p),
                "influence of cross-entropy": 1.0 - p,
                "weight": self.weight_at(p),
            }
            title = f"{type(self).__name__}: σ = {float(self.kappa) ** -0.5 if self.kappa > 0 else torch.inf:.3g}"
            return self._drawn(axes, p, curves, "probability of the label", title)

    def _given(self, probability: Tensor) -> tuple[Tensor, Tensor]:
        refuse_not_real("probability", probability)
        refuse_out_of_range("probability", probability, 0.0, 1.0, "[]", "logits go through softmax first")
        p = probability.to(torch.promote_types(probability.dtype, torch.float32))
        return p, self.kappa.to(p.dtype)
