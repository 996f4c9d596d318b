"""What a loss does with a residual: its value, its pull, and the weight of the residual beside least squares."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from mkc_torch._support.arguments import refuse_not_real
from mkc_torch.density.energy import energy, energy_dz

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["Curves"]

_REACH, _POINTS = 6.0, 401


class Curves:
    """Methods of a loss with ``kappa`` and ``d`` of each channel."""

    kappa: Any
    d: Any
    num_channels: Any

    def rho(self, error: Float[Tensor, "*batch m"]) -> Float[Tensor, "*batch m"]:
        """The energy ``σ² (1 - exp(-e² / (2 d² σ²)))`` of errors, the last dimension being the channels.

        Example:
            >>> from mkc_torch import MKCLoss
            >>> MKCLoss(1, sigma=2.0, d=1.0, bound=9.0).rho(torch.tensor([[0.0], [100.0]])).round().tolist()
            [[0.0], [4.0]]
        """
        z, kappa, _ = self._standardised(error)
        return energy(z, kappa)

    def influence(self, error: Float[Tensor, "*batch m"]) -> Float[Tensor, "*batch m"]:
        """The derivative of :meth:`rho` by the error: how hard an error pulls, in one over the unit of the target."""
        z, kappa, d = self._standardised(error)
        return energy_dz(z, kappa) / d

    def weight(self, error: Float[Tensor, "*batch m"]) -> Float[Tensor, "*batch m"]:
        """The pull beside that of least squares of the same d, in [0, 1]: ``exp(-e² / (2 d² σ²))``, (15) of the paper.

        Example:
            >>> from mkc_torch import MKCLoss
            >>> MKCLoss(1, sigma=2.0, d=1.0, bound=9.0).weight(torch.tensor([[0.0], [100.0]])).detach()
            tensor([[1.],
                    [0.]])
        """
        z, kappa, _ = self._standardised(error)
        return torch.exp(-0.5 * kappa * z.square())

    def plot(self, channel: int = 0, axes: Any = None) -> Any:
        """Draw value, pull and weight of a channel over the error, and give the axes back; needs matplotlib.

        Args:
            channel: which, from 0.
            axes: matplotlib's, or None for a new figure.

        Raises:
            ValueError: there is no such channel.
            ModuleNotFoundError: matplotlib is not installed; the extra ``cli`` has it.
        """
        if not 0 <= channel < self.num_channels:
            raise ValueError(f"Expected argument `channel` in [0, {self.num_channels}) but got {channel}.")
        from matplotlib.figure import Figure

        axes = Figure(layout="constrained").add_subplot() if axes is None else axes
        with torch.no_grad():
            d = self.d
            reach = _REACH * float(d[channel])
            error = torch.zeros(_POINTS, self.num_channels, dtype=d.dtype, device=d.device)
            error[:, channel] = torch.linspace(-reach, reach, _POINTS, dtype=d.dtype, device=d.device)
            x = error[:, channel].tolist()
            for name, values in (
                ("value", self.rho(error)),
                ("pull, times d", self.influence(error) * d),
                ("weight", self.weight(error)),
            ):
                axes.plot(x, values[:, channel].tolist(), label=name)
        axes.set_xlabel("error, in the unit of the target")
        axes.legend()
        return axes

    def _standardised(self, error: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        refuse_not_real("error", error)
        if error.dim() == 0 or error.shape[-1] != self.num_channels:
            raise ValueError(
                f"Expected argument `error` with {self.num_channels} channels in its last dimension but got "
                f"{tuple(error.shape)}."
            )
        kappa, d = self.kappa, self.d
        dtype = torch.promote_types(error.dtype, d.dtype)
        kappa, d = kappa.to(dtype), d.to(dtype)
        return error.to(dtype) / d, kappa.expand(error.shape), d
