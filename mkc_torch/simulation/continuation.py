"""The residual on the way of one fit: each answer begins with the one before it."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from typing import TYPE_CHECKING

from torch import Tensor

from mkc_torch._support.torch_internals import is_wrapped
from mkc_torch.simulation.protocol import Changes, Nearby, PreparedSimulation

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["Continuation"]

_MOST_KEPT = 64
"""Answers of a way that are kept: a fit comes back to one of its last ones."""


class Continuation:
    """A function of a fit's parameters that remembers the answers on the way of that fit, and of no other.

    Args:
        prepared: the simulation.
        meaning: the simulation's own parameters and the changes at its ports, by those of the fit.
        near: what the first answer begins with.
    """

    def __init__(
        self,
        prepared: PreparedSimulation,
        meaning: Callable[[Tensor], tuple[Tensor, Changes]],
        near: Nearby | None = None,
    ) -> None:
        self._prepared, self._meaning, self._last = prepared, meaning, near
        self._known: OrderedDict[bytes, Nearby] = OrderedDict()
        self._last_key = b""

    def __call__(self, parameters: Float[Tensor, " p"]) -> Float[Tensor, "N m"]:
        """The residual."""
        theta, changes = self._meaning(parameters)
        if is_wrapped(parameters):
            return self._prepared.answer(theta, changes, self._last).residual
        key = _key(parameters)
        # what was found on the way is not always found again from elsewhere
        near = self._last if key == self._last_key else self._known.get(key, self._last)
        residual, nearby = self._prepared.answer(theta, changes, near)
        if nearby is not None:
            self._last, self._last_key = nearby, key
            self._known[key] = nearby.bare
            self._known.move_to_end(key)
            while len(self._known) > _MOST_KEPT:
                self._known.popitem(last=False)
        return residual

    def near(self, parameters: Float[Tensor, " p"]) -> Nearby | None:
        """What an answer at these parameters begins with: the one that was found there, or else the last one."""
        last = None if self._last is None else self._last.bare
        return self._known.get(_key(parameters), last)


def _key(parameters: Tensor) -> bytes:
    return parameters.detach().cpu().numpy().tobytes()
