"""Errors for gradients that do not exist: which problems, and why."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


class NotDifferentiableError(ValueError):
    """A derivative was taken of a fit that has not converged or is not at a strict minimum."""


class RaisingIdentity(torch.autograd.Function):
    """The identity, whose derivative raises for problems with a nonzero ``cause``.

    Backward raises only where a gradient arrives: a problem left out of the loss has a gradient of zeros.
    """

    @staticmethod
    def forward(value: Tensor, cause: Tensor, check: str) -> Tensor:
        refused = cause != 0
        if check and bool(refused.any()):
            requested = refused & (value != 0).any(-1) if check == "requested" else refused
            if _any_true(requested):
                raise NotDifferentiableError(_refusal(cause, refused))
        return value.clone()

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor, str], output: Tensor) -> None:  # noqa: ARG004 - signature of torch.autograd.Function
        ctx.save_for_backward(inputs[1])
        ctx.save_for_forward(inputs[1])

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None]:
        return RaisingIdentity.apply(grad, ctx.saved_tensors[0], "requested"), None, None  # type: ignore[no-untyped-call]

    @staticmethod
    def jvp(ctx: Any, tangent: Tensor, *_: None) -> Tensor:
        result: Tensor = RaisingIdentity.apply(tangent, ctx.saved_tensors[0], "all")  # type: ignore[no-untyped-call]
        return result

    @staticmethod
    def vmap(
        info: Any, in_dims: tuple[int | None, int | None, None], value: Tensor, cause: Tensor, check: str
    ) -> tuple[Tensor, int]:
        size = info.batch_size
        value, cause = (
            v.expand(size, *v.shape) if dim is None else v.movedim(dim, 0)
            for v, dim in zip((value, cause), in_dims[:2], strict=True)
        )
        return RaisingIdentity.apply(value, cause, check), 0  # type: ignore[no-untyped-call]


def _any_true(mask: Tensor) -> bool:
    try:
        return bool(mask.any())
    except RuntimeError:  # gradients that autograd itself batches have no single value
        return True


_NOT_CONVERGED, _NO_MINIMUM = 1, 2


def _refusal(cause: Tensor, refused: Tensor) -> str:
    first = tuple(int(i) for i in refused.nonzero()[0])
    which = f"problem {', '.join(map(str, first))}" if first else "a fit"
    leave_out = ", or leave the problem out of the loss by `differentiable_`" if first else ""
    if int(cause[first]) == _NOT_CONVERGED:
        return (
            f"Expected a converged fit to differentiate but got {which} that has not converged; raise "
            f"`max_iter`{leave_out}."
        )
    return (
        f"Expected a strict minimum to differentiate at but got {which} where the Hessian of the objective is singular "
        "or not positive definite, so that the result is not a smooth function of the data; take more samples, or a "
        f"larger `sigma` or `d` where they are given{leave_out}."
    )
