"""What a loss does that takes d and bound from its residuals."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from mkc_torch.losses._checks import Reduction
from mkc_torch.losses._following import SEARCH_EVERY, Followed, Following, bound_of, scale_of
from mkc_torch.losses._state_dict import logit_of_scale, ratio_of
from mkc_torch.losses._steering import late_of, limited, steered, steered_each

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["FollowsResiduals"]


class FollowsResiduals(nn.Module):
    """The part of an MKCLoss that has a :class:`Following`; one with a given d has none, but may be guided by one."""

    following: Following | None
    _guide: Following | None
    kappa: Any
    d: Any
    bound: Tensor
    d_min: Tensor
    raw_d: nn.Parameter | None
    fixed_d: Tensor | None
    reduction: Reduction
    _own_bound: bool
    _own_floor: bool
    _has_begun: bool
    _turned: bool
    _passes: int

    @torch.no_grad()
    def settle(self) -> None:
        """Stop following the residuals: d and bound stay at what they are, as if they had been given.

        For an optimiser that needs the same function at every call, L-BFGS say, or to compare likelihoods.

        Example:
            >>> from mkc_torch import MKCLoss
            >>> loss = MKCLoss(1)
            >>> _ = loss(torch.tensor([[-1.0], [1.0], [3.0]]), torch.zeros(3, 1))
            >>> loss.settle()
            >>> loss.following is None, bool(loss.bound > 5.0 * loss.d)
            (True, True)
        """
        if self.following is None:
            return
        d = self._followed_d(self.following.state)
        d = torch.minimum(torch.maximum(d, self.d_min * (1.0 + 1e-6)), 0.5 * self.bound)
        self.following, self._own_bound, self._own_floor = None, True, True
        if self.raw_d is None:
            self.fixed_d = d
        else:
            self.raw_d.copy_(logit_of_scale(d, self.d_min, self.bound))

    def follow_guide(self, guide: Following | None) -> None:
        """Let the network learn by the first loss, and then by the likelihood no wider than a guide's bandwidth.

        None ends this. The value, σ, d and the bound stay the likelihood's; a guide is no part of the ``state_dict``.
        """
        self.__dict__["_guide"] = guide
        self._turned, self._passes = False, 0 if guide is None else int(guide.seen)

    def _followed_d(self, state: Followed) -> Float[Tensor, " m"]:
        scale = scale_of(state)
        if self.raw_d is not None:
            scale = scale * ratio_of(self.raw_d)
        bound, floor = self._domain(state)
        return torch.minimum(torch.maximum(scale, floor), 0.5 * bound)

    def _domain(self, state: Followed) -> tuple[Float[Tensor, " m"], Float[Tensor, " m"]]:
        """Bound and floor of d."""
        return self.bound if self._own_bound else bound_of(state), self.d_min if self._own_floor else state.floor

    def _state(self, input: Tensor, target: Tensor, error: Tensor | None, weight: Tensor | None, axis: int) -> Followed:
        """What is known with this batch; kept in training, but under transforms of functions, which have no state."""
        assert self.following is not None
        compiled = torch.compiler.is_compiling()
        if not compiled and torch._C._functorch.is_functorch_wrapped_tensor(input):
            return self.following.state
        learning = self.training and torch.is_grad_enabled()
        if not learning and (compiled or self._begun()):
            return self.following.state
        # compiled code is one for all batches
        search = compiled or self._passes % SEARCH_EVERY == 0
        state = self.following.after(input, target, weight, axis, error=error, search=search)
        if not compiled:
            _refuse_huge(state.far)
        if learning:
            if not compiled:
                self._passes += 1
            self.following.keep(state)
            bound, floor = self._domain(state)
            with torch.no_grad():
                self.bound.copy_(bound)
                self.d_min.copy_(floor)
        return state

    def _begun(self) -> bool:
        """Whether there has been a batch to take the scale from."""
        assert self.following is not None
        if not self._has_begun:
            self._has_begun = bool(self.following.seen > 0)
        return self._has_begun

    def _guided(
        self, input: Tensor, target: Tensor, error: Tensor | None, weight: Tensor | None, axis: int
    ) -> Followed | None:
        """What a guide knows with this batch, if there is one and the network learns."""
        compiled = torch.compiler.is_compiling()
        if self._guide is None or (not compiled and torch._C._functorch.is_functorch_wrapped_tensor(input)):
            return None
        if self._guide.seen.device != input.device:
            self._guide.to(input.device)
        search = compiled or self._passes % SEARCH_EVERY == 0
        state = self._guide.after(input, target, weight, axis, error=error, search=search)
        if not compiled:
            self._passes += 1
        self._guide.keep(state)
        return state

    def _pull(self, input: Tensor, target: Tensor | None, weight: Tensor | None, axis: int, state: Followed) -> Tensor:
        """What the network learns by: of each element, or summed."""
        late = late_of(state) if self._guide is None else limited(state, self.kappa.detach(), self.d.detach())
        if self.reduction == "none":
            return steered_each(input if target is None else input - target, axis, state, late)
        return steered(input, target, weight, axis, state, late, turned=self._turned).sum()


def _refuse_huge(far: Float[Tensor, " m"]) -> None:
    """Refuse errors that what is remembered of them cannot hold, where looking waits for no accelerator."""
    if far.device.type == "cpu" and not bool(torch.isfinite(far).all()):
        raise ValueError(
            f"Expected arguments `input` and `target` to differ by less than {torch.finfo(far.dtype).max:.0e}, which "
            f"{far.dtype} ends at; choose a unit near the scale of the targets, or look at them."
        )
