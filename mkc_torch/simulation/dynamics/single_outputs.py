"""Changes of single outputs by effects, before the sensors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from torch import Tensor

from mkc_torch.simulation.ports import Changes

if TYPE_CHECKING:
    from jaxtyping import Float


def with_changes(
    y: Mapping[str, Float[Tensor, " N"]], changes: Changes, like: Float[Tensor, " N"]
) -> dict[str, Float[Tensor, " N"]]:
    """The outputs with the changes at the ports of single outputs.

    Args:
        y: the outputs, by name.
        changes: the changes by effects, by port.
        like: values of the outputs' shape; an output may be a number.

    Example:
        >>> import torch
        >>> zeros = torch.zeros(2)
        >>> with_changes({"level": zeros, "flow": zeros}, {"output flow": lambda signal: signal + 2.0}, zeros)
        {'level': tensor([0., 0.]), 'flow': tensor([2., 2.])}
    """
    changed = dict(y)
    for name, value in y.items():
        if (change := changes.get(f"output {name}")) is not None:
            signal = (value + 0.0 * like).unsqueeze(-1)
            changed[name] = (signal + change(signal))[:, 0]
    return changed
