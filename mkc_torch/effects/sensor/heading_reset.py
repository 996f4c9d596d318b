"""A recorded attitude whose heading was reset while the sensor did not turn."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from torch import Tensor

from mkc_torch.effects.base import Effect
from mkc_torch.effects.context import Context, Quantity, Shape

if TYPE_CHECKING:
    from jaxtyping import Float


class HeadingReset(Effect):
    """The attitude filter reset its heading by an angle by which the sensor did not turn.

    Simulation: rotates the ambient field about the vertical by φ_k, from the k-th jump of the recorded heading on.
    Drivers: none; the jumps are those of the attitude that the gyroscope does not show.
    Units: φ in °.
    Plausible: up to 180°.
    Source: filters align their heading by the compass again at arming and after take-off (ArduPilot, EKF yaw resets).

    Example:
        >>> import torch
        >>> from mkc_torch.effects import Context
        >>> since = torch.tensor([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]])
        >>> context = Context(
        ...     torch.arange(3.0), torch.zeros(3, 0), (), since, "°", ("heading",), ("since_1", "since_2")
        ... )
        >>> HeadingReset().change(torch.tensor([15.0, -6.0]), {}, context).squeeze(-1)
        tensor([ 0., 15.,  9.])
    """

    id = "heading_reset"
    port = "heading"
    lower = -180.0
    upper = 180.0
    equation = "B = R_z(Σ φ_k · 1[t > t_k]) B₀"
    explanation = "The recorded heading was reset: the attitude turned about the vertical and the sensor did not."
    advice = "Use an attitude that does not depend on this sensor, or only the samples between two jumps."
    recurrence = "an attitude that does not depend on this sensor is not reset"
    location_specific = True
    follows_signal = False  # the signal here is known and has no noise
    plausible = 180.0
    plausible_unit = "°"
    source = "filters align their heading by the compass again at arming and after take-off"

    def moments(self, context: Context) -> tuple[float, ...]:
        # the last sample before each jump
        before = (context.signal <= 0.0).sum(0) - 1
        return tuple(context.time[before].tolist())

    def components(self, quantity: str, shape: Shape, context: Context) -> tuple[str, ...]:
        return tuple(f"jump at {moment:.1f} s" for moment in self.moments(context))

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:
        return (Quantity("heading_change", len(context.carries), context.signal_unit),)

    def change(self, gamma: Float[Tensor, " q"], shape: Shape, context: Context) -> Float[Tensor, "N 1"]:
        return (context.signal @ gamma).unsqueeze(-1)
