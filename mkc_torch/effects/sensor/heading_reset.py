"""A recorded attitude whose heading was set anew while the sensor did not turn."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from torch import Tensor

from mkc_torch.effects.base import Effect
from mkc_torch.effects.context import Context, Quantity, Shape

if TYPE_CHECKING:
    from jaxtyping import Float


class HeadingReset(Effect):
    """The filter that the attitude is from set its heading anew, by an angle that the sensor did not turn by.

    Simulation: turns the ambient field about the vertical, by φ_k from the k-th jump of the recorded heading on.
    Drivers: none; the jumps are those of the attitude that the gyroscope knows nothing of.
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
    least, most = -180.0, 180.0
    equation = "B = R_z(Σ φ_k · 1[t > t_k]) B₀"
    explanation = "The recorded heading was set anew: the attitude turned about the vertical and the sensor did not."
    advice = "Use an attitude that this sensor does not steer, or the samples from between two of the jumps."
    recurrence = "an attitude that this sensor does not steer is not set anew"
    location_specific = True
    follows_signal = False  # what passes here is known and has no noise
    plausible = 180.0
    plausible_unit = "°"
    source = "filters align their heading by the compass again at arming and after take-off"

    def moments(self, context: Context) -> tuple[float, ...]:
        # the last sample before each jump, as the simulation tells them
        before = (context.signal <= 0.0).sum(0) - 1
        return tuple(context.time[before].tolist())

    def components(self, quantity: str, shape: Shape, context: Context) -> tuple[str, ...]:  # noqa: ARG002
        return tuple(f"jump at {moment:.1f} s" for moment in self.moments(context))

    def quantities(self, shape: Shape, context: Context) -> Sequence[Quantity]:  # noqa: ARG002
        return (Quantity("heading_change", len(context.carries), context.signal_unit),)

    def change(self, gamma: Float[Tensor, " q"], shape: Shape, context: Context) -> Float[Tensor, "N 1"]:  # noqa: ARG002
        return (context.signal @ gamma).unsqueeze(-1)
