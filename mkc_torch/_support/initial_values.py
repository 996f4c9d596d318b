"""Modules whose own parameters and buffers have initial values, which ``reset_parameters`` restores.

Model loaders and sharded trainings construct a module on the meta device, where tensors have no values, and give it
memory afterwards. The initial values are therefore computed on the CPU, and kept there, outside the state_dict.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn
from typing_extensions import Self

from mkc_torch._support.arguments import as_numbers

_HALF = (torch.float16, torch.bfloat16)
"""Types in which a module's own values would be rounded, or overflow."""


class InitialValues(nn.Module):
    """A module that knows the initial values of its own parameters and buffers, and keeps them in float32 at least.

    Example:
        >>> class Bound(InitialValues):
        ...     def __init__(self) -> None:
        ...         super().__init__()
        ...         self._register("bound", initial_numbers("bound", 50.0))
        >>> with torch.device("meta"):
        ...     module = Bound()
        >>> module.to_empty(device="cpu").reset_parameters()
        >>> module.bound
        tensor(50.)
    """

    def __init__(self) -> None:
        super().__init__()
        self._initial: dict[str, Tensor] = {}

    def _register(self, name: str, value: Tensor | None, *, learned: bool | None = None) -> None:
        """Register a buffer, or a parameter if ``learned`` is not None: whether it has a gradient."""
        own = None
        if value is not None:
            self._initial[name] = value.detach()
            own = placed(value)
        if learned is None:
            self.register_buffer(name, own)
        else:
            self.register_parameter(name, None if own is None else nn.Parameter(own, requires_grad=learned))

    @torch.no_grad()
    def reset_parameters(self) -> None:
        """Set the module's own parameters and buffers to their initial values, for example after ``to_empty``.

        Raises:
            ValueError: an initial value was given as a tensor of the meta device, which has no values.
        """
        for name, value in self._initial.items():
            set_values(name, getattr(self, name), value)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        """Keep the module's own parameters and buffers in float32 at least."""

        def keep(t: Tensor) -> Tensor:
            out = fn(t)
            return t.to(out.device) if out.dtype in _HALF else out

        if recurse:
            for child in self.children():
                child._apply(fn)
        super()._apply(keep, recurse=False)  # type: ignore[no-untyped-call]
        return self

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *rest: Any) -> None:
        for name in (*self._parameters, *self._buffers):
            value = state_dict.get(prefix + name)
            if isinstance(value, Tensor) and value.dtype in _HALF:  # with `assign`, the module would take its type
                state_dict[prefix + name] = value.float()
        super()._load_from_state_dict(state_dict, prefix, *rest)


class InitialParameters(nn.ParameterList):
    """A list of parameters without gradients, with their initial values.

    Example:
        >>> parameters = InitialParameters([torch.ones(2)])
        >>> parameters[0].zero_()
        Parameter containing:
        tensor([0., 0.])
        >>> parameters.reset_parameters()
        >>> parameters[0]
        Parameter containing:
        tensor([1., 1.])
    """

    def __init__(self, values: Any) -> None:
        super().__init__()
        self._initial = [value.detach().clone() for value in values]
        self.extend(nn.Parameter(placed(value), requires_grad=False) for value in self._initial)

    @torch.no_grad()
    def reset_parameters(self) -> None:
        """Set each parameter to its initial value."""
        for number, value in enumerate(self._initial):
            set_values(str(number), self[number], value)


def initial_numbers(name: str, value: object) -> Tensor:
    """A tensor unchanged; a number, or a sequence of numbers, on the CPU whatever the default device.

    Raises:
        TypeError: it is not numeric, or complex.
    """
    dtype = torch.promote_types(torch.get_default_dtype(), torch.float32)
    return as_numbers(name, value, dtype, torch.device("cpu"))


def has_values(*tensors: Tensor) -> bool:
    """Whether all tensors have values: those of the meta device have none."""
    return not any(tensor.is_meta for tensor in tensors)


def is_readable(tensor: Tensor) -> bool:
    """Whether a process can read all values alone: they exist, and are not sharded over processes."""
    return has_values(tensor) and not _is_sharded(tensor)


def placed(value: Tensor) -> Tensor:
    """A copy on the default device, or on the value's own device if that is not the CPU."""
    device = torch.empty(0).device if value.device.type == "cpu" else value.device
    return value.detach().to(device, copy=True)


def set_values(name: str, target: Tensor, values: Tensor) -> None:
    """Copy initial values into a parameter or buffer, which may be sharded over processes or on the meta device.

    Raises:
        ValueError: the values are on the meta device, and the target is not.
    """
    if not has_values(values) and has_values(target):
        raise ValueError(
            f"Expected an initial value of `{name}` but it was given as a tensor of the meta device, which has no "
            "values; construct the module with numbers, or load a state_dict."
        )
    if _is_sharded(target):
        from torch.distributed.tensor import distribute_tensor

        sharded: Any = target
        values = distribute_tensor(values.to(target.device), sharded.device_mesh, sharded.placements)
    target.copy_(values)


def _is_sharded(tensor: Tensor) -> bool:
    return hasattr(tensor, "placements")
