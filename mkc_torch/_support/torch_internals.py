"""Private functions of torch that have no public counterpart; every other file takes them from here."""

from __future__ import annotations

import torch
from torch import Tensor
from torch._functorch.pyfunctorch import temporarily_clear_interpreter_stack  # no public way out of a transform
from torch.autograd import forward_ad

__all__ = [
    "forward_mode_is_active",
    "functorch_is_active",
    "in_backward",
    "is_transformed",
    "is_wrapped",
    "temporarily_clear_interpreter_stack",
]


def is_wrapped(tensor: Tensor) -> bool:
    """Whether a tensor belongs to a transform of ``torch.func``: torch.func has no public test for it."""
    return torch._C._functorch.is_functorch_wrapped_tensor(tensor)


def is_transformed(tensor: Tensor) -> bool:
    """Whether a tensor belongs to a transform of ``torch.func`` or carries a forward-mode tangent."""
    return torch._C._functorch.is_functorch_wrapped_tensor(tensor) or forward_ad.unpack_dual(tensor).tangent is not None


def functorch_is_active() -> bool:
    """Whether a transform of ``torch.func`` is running: torch.func has no public test for it."""
    return torch._C._are_functorch_transforms_active()


def forward_mode_is_active() -> bool:
    """Whether a level of forward-mode differentiation is entered: torch has no public test for it."""
    return forward_ad._current_level >= 0


def in_backward() -> bool:
    """Whether a backward pass is running, as while activation checkpointing recomputes a forward pass.

    torch.utils.checkpoint has no public way to distinguish the recomputation from the first pass.
    """
    return torch._C._current_graph_task_id() != -1
