"""Curves of a loss over a residual: value, influence and weight.

Every loss has ``rho``, the value; ``influence``, its derivative; ``weight``, the influence relative to that of the
non-robust loss; and ``plot``. Their arguments differ and are documented in each class.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from mkc_torch._support.arguments import checked_number, refuse_not_real
from mkc_torch.density.energy import SIGMA_LEAST, energy, energy_dz
from mkc_torch.functional import mkc_energy, mkc_weight

if TYPE_CHECKING:
    from jaxtyping import Float

_REACH = 3.0
"""Half-width of a picture in bandwidths: the weight there is 1 %."""

_LEAST_REACH = 6.0
"""Half-width of a picture in scales, at least."""

_LONGEST_REACH = 20.0
"""Half-width of a picture in scales, at most."""

_POINTS = 401
"""Points per curve of a picture."""

_OF_ERRORS = "error, in the unit of the target"


class Curves:
    """Base class that draws the curves of a loss."""

    @staticmethod
    def _drawn(
        axes: Any, x: Float[Tensor, " P"], curves: dict[str, Float[Tensor, " P"]], xlabel: str, title: str
    ) -> Any:
        """Draw each curve over x in its own colour, on given axes or a new figure; needs matplotlib."""
        if axes is None:
            from matplotlib.figure import Figure

            axes = Figure(figsize=(6.4, 4.0), layout="constrained").add_subplot()
        for name, values in curves.items():
            axes.plot(x.tolist(), values.tolist(), label=name)
        axes.axhline(0.0, color="0.8", linewidth=0.8, zorder=0)
        axes.set_xlabel(xlabel)
        axes.set_title(title, fontsize="medium")
        axes.legend(frameon=False)
        return axes


class ChannelCurves(Curves):
    """Curves of a loss with ``kappa`` and ``d`` per channel, over errors (*, m)."""

    kappa: Any
    d: Any
    num_channels: Any

    def rho(self, error: Float[Tensor, "*batch m"]) -> Float[Tensor, "*batch m"]:
        """Energy ``σ² (1 - exp(-e² / (2 d² σ²)))`` of errors (*, m).

        Example:
            >>> from mkc_torch import MKCLoss
            >>> MKCLoss(1, sigma=2.0, d=1.0, bound=9.0).rho(torch.tensor([[0.0], [100.0]])).round().tolist()
            [[0.0], [4.0]]
        """
        z, kappa, _ = self._standardised(error)
        return energy(z, kappa)

    def influence(self, error: Float[Tensor, "*batch m"]) -> Float[Tensor, "*batch m"]:
        """Derivative of :meth:`rho` with respect to the error, in 1 / unit of the target."""
        z, kappa, d = self._standardised(error)
        return energy_dz(z, kappa) / d

    def weight(self, error: Float[Tensor, "*batch m"]) -> Float[Tensor, "*batch m"]:
        """Influence relative to least squares with the same d, ``exp(-e² / (2 d² σ²))`` in [0, 1]: (15) of the paper.

        Example:
            >>> from mkc_torch import MKCLoss
            >>> MKCLoss(1, sigma=2.0, d=1.0, bound=9.0).weight(torch.tensor([[0.0], [100.0]])).detach()
            tensor([[1.],
                    [0.]])
        """
        z, kappa, _ = self._standardised(error)
        return torch.exp(-0.5 * kappa * z.square())

    def plot(self, channel: int = 0, axes: Any = None) -> Any:
        """Draw value, influence and weight of a channel over the error, and return the axes; needs matplotlib.

        The value is drawn over σ², its limit, and undivided for σ = ∞.

        Args:
            channel: index of the channel, from 0.
            axes: axes of matplotlib, or None for a new figure.

        Raises:
            ValueError: the channel does not exist.
            ModuleNotFoundError: matplotlib is not installed; the extra ``cli`` has it.
        """
        if isinstance(channel, bool) or not isinstance(channel, int) or not 0 <= channel < self.num_channels:
            raise ValueError(
                f"Expected argument `channel` in [0, {self.num_channels}) but got {channel!r}; 0 is the first."
            )
        with torch.no_grad():
            kappa, d = self.kappa[channel], self.d[channel]
            sigma = float(kappa) ** -0.5 if kappa > 0 else math.inf
            error = _errors(sigma, d).unsqueeze(-1).expand(-1, self.num_channels)
            values, influences, weights = (
                value[:, channel] for value in (self.rho(error), self.influence(error), self.weight(error))
            )
            title = f"{type(self).__name__}, channel {channel}: σ = {sigma:.3g}, d = {float(d):.3g}"
            curves = _shown(values, influences, weights, sigma, d)
            return self._drawn(axes, error[:, channel], curves, _OF_ERRORS, title)

    def _standardised(self, error: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        refuse_not_real("error", error)
        if error.dim() == 0 or error.shape[-1] != self.num_channels:
            raise ValueError(
                f"Expected argument `error` with {self.num_channels} channels in its last dimension but got "
                f"{tuple(error.shape)}; for a single channel pass error.unsqueeze(-1)."
            )
        kappa, d = self.kappa, self.d
        dtype = torch.promote_types(error.dtype, d.dtype)
        kappa, d = kappa.to(dtype), d.to(dtype)
        return error.to(dtype) / d, kappa.expand(error.shape), d


class SampleCurves(Curves):
    """Curves of a loss with σ and d per error; all three broadcast."""

    def rho(
        self, error: Float[Tensor, "*batch"], sigma: float | Float[Tensor, "*batch"], d: float | Float[Tensor, "*batch"]
    ) -> Float[Tensor, "*batch"]:
        """Energy ``σ² (1 - exp(-e² / (2 d² σ²)))`` of errors, without the normaliser, which does not depend on them.

        Args:
            error: errors, in the unit of the target.
            sigma: bandwidths in [0.05, inf].
            d: scales, in the unit of the errors.

        Raises:
            TypeError, ValueError: an argument of another type, or out of range.

        Example:
            >>> from mkc_torch import HeteroscedasticMKCLoss
            >>> loss = HeteroscedasticMKCLoss(bound=50.0)
            >>> loss.rho(torch.tensor([1.0, 1.0]), sigma=2.0, d=torch.tensor([1.0, 0.01]))  # noise of 1 and of 0.01
            tensor([0.4700, 4.0000])
        """
        return mkc_energy(*_sampled(error, sigma, d))

    def influence(
        self, error: Float[Tensor, "*batch"], sigma: float | Float[Tensor, "*batch"], d: float | Float[Tensor, "*batch"]
    ) -> Float[Tensor, "*batch"]:
        """Derivative of :meth:`rho` with respect to the error, in 1 / unit of the target; same arguments."""
        error, sigma, d = _sampled(error, sigma, d)
        return error / d * mkc_weight(error, sigma, d) / d

    def weight(
        self, error: Float[Tensor, "*batch"], sigma: float | Float[Tensor, "*batch"], d: float | Float[Tensor, "*batch"]
    ) -> Float[Tensor, "*batch"]:
        """Influence relative to that of least squares with the same d, in [0, 1]; arguments of :meth:`rho`."""
        return mkc_weight(*_sampled(error, sigma, d))

    def plot(self, sigma: float = 3.0, d: float = 1.0, axes: Any = None) -> Any:
        """Draw value, influence and weight over the error of a sample, and return the axes; needs matplotlib.

        The value is drawn over σ², its limit, and undivided for σ = ∞.

        Args:
            sigma, d: bandwidth and scale of the sample.
            axes: axes of matplotlib, or None for a new figure.

        Raises:
            TypeError, ValueError: σ or d is not a number, or out of range.
            ModuleNotFoundError: matplotlib is not installed; the extra ``cli`` has it.
        """
        checked_number("sigma", sigma, SIGMA_LEAST, math.inf, "[]", "3 is usual")
        checked_number("d", d, advice="1 draws errors in scales")
        scale = torch.tensor(d, dtype=torch.float64)
        error = _errors(sigma, scale)
        value, influence, weight = (curve(error, sigma, d) for curve in (self.rho, self.influence, self.weight))
        title = f"{type(self).__name__}: σ = {sigma:.3g}, d = {d:.3g}"
        return self._drawn(axes, error, _shown(value, influence, weight, sigma, scale), _OF_ERRORS, title)


def _errors(sigma: float, d: Float[Tensor, ""]) -> Float[Tensor, " P"]:
    reach = _LEAST_REACH if sigma == math.inf else min(max(_LEAST_REACH, _REACH * sigma), _LONGEST_REACH)
    return d * torch.linspace(-reach, reach, _POINTS, dtype=d.dtype, device=d.device)


def _sampled(error: Tensor, sigma: float | Tensor, d: float | Tensor) -> tuple[Tensor, Tensor, Tensor]:
    refuse_not_real("error", error)
    like = torch.promote_types(error.dtype, torch.float32)
    return error.to(like), torch.as_tensor(sigma, dtype=like), torch.as_tensor(d, dtype=like)


def _shown(value: Tensor, influence: Tensor, weight: Tensor, sigma: float, d: Tensor) -> dict[str, Tensor]:
    """Curves by label, scaled to similar size."""
    bounded = sigma < math.inf
    return {
        "value / σ²" if bounded else "value": value / sigma**2 if bounded else value,
        "influence · d": influence * d,
        "weight": weight,
    }
