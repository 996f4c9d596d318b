"""A simulation outside torch as a torch function with first derivatives: reverse mode, forward mode, ``vmap``.

The derivatives by states, inputs and parameters are computed where a derivative is needed, and have no derivatives
themselves. A vector-Jacobian product is linear in its vector, and so its derivative by the vector is exact; its
derivative by states, inputs or parameters is refused in reverse mode.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from mkc_torch._support.torch_internals import is_wrapped
from mkc_torch.simulation.foreign.evaluation import GROUPS, CachedEvaluation, EvaluationPoints, Group


def evaluated(
    evaluation: CachedEvaluation, outputs: bool, time: Tensor, states: Tensor, inputs: Tensor, parameters: Tensor
) -> Tensor:
    """The rates (S, n), or the outputs (S, k), of a simulation.

    Args:
        evaluation: its evaluation.
        outputs: return outputs instead of rates.
        time: (S,), in s.
        states, inputs: (S, n), (S, m).
        parameters: (p,), a number each.

    Raises:
        ValueError: a parameter varies from sample to sample.
    """
    if parameters.dim() != 1:
        raise ValueError(
            f"parameters: expected (p,), a number for each, got {tuple(parameters.shape)}. A simulation outside torch "
            "has the same parameters at all samples."
        )
    return _values(evaluation, outputs, time, states, inputs, parameters)


class _Values(torch.autograd.Function):
    @staticmethod
    def forward(
        evaluation: CachedEvaluation, outputs: bool, time: Tensor, states: Tensor, inputs: Tensor, parameters: Tensor
    ) -> Tensor:
        return _tensor(evaluation.values(outputs, _moments(time, states, inputs, parameters)), states)

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:  # noqa: ARG004 - signature of torch.autograd.Function
        ctx.evaluation, ctx.outputs = inputs[:2]
        ctx.save_for_backward(*inputs[2:])
        ctx.save_for_forward(*inputs[2:])
        ctx.set_materialize_grads(False)
        ctx.kept = {}

    @staticmethod
    def backward(ctx: Any, *grads: Any) -> Any:
        (weights,) = grads
        found: list[Tensor | None] = [None, None, None]
        for k, group in enumerate(GROUPS):
            if weights is not None and ctx.needs_input_grad[3 + k]:
                slopes = _kept_slopes(ctx, group)
                weighed = weights.unsqueeze(-1) * slopes
                found[k] = weighed.sum((-3, -2)) if group == "parameters" else weighed.sum(-2)
        return None, None, None, *found

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> Any:
        total = None
        for group, tangent in zip(GROUPS, tangents[3:], strict=True):
            if tangent is None:
                continue
            slopes = _slopes(ctx.evaluation, ctx.outputs, group, *ctx.saved_tensors)
            part = (slopes * tangent.unsqueeze(-2)).sum(-1)
            total = part if total is None else total + part
        return total

    @staticmethod
    def vmap(info: Any, in_dims: Any, evaluation: CachedEvaluation, outputs: bool, *parts: Tensor) -> Any:
        return _over_batch(info, in_dims[2:], lambda *args: _values(evaluation, outputs, *args), parts), 0


class _Slopes(torch.autograd.Function):
    @staticmethod
    def forward(
        evaluation: CachedEvaluation,
        outputs: bool,
        group: Group,
        time: Tensor,
        states: Tensor,
        inputs: Tensor,
        parameters: Tensor,
    ) -> Tensor:
        return _tensor(evaluation.slopes(outputs, _moments(time, states, inputs, parameters), group), states)

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:  # noqa: ARG004 - signature of torch.autograd.Function
        ctx.shape = output.shape

    @staticmethod
    def backward(ctx: Any, *grads: Any) -> Any:  # noqa: ARG004 - signature of torch.autograd.Function
        raise RuntimeError(
            "A simulation outside torch, such as an FMU, has first derivatives only; its second derivatives are "
            "not known."
        )

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> Any:
        known = next(tangent for tangent in tangents if isinstance(tangent, Tensor))
        return known.new_zeros(ctx.shape)

    @staticmethod
    def vmap(info: Any, in_dims: Any, evaluation: CachedEvaluation, outputs: bool, group: Group, *parts: Tensor) -> Any:
        return _over_batch(info, in_dims[3:], lambda *args: _slopes(evaluation, outputs, group, *args), parts), 0


_values: Callable[..., Tensor] = _Values.apply
_slopes: Callable[..., Tensor] = _Slopes.apply


for _function in (_Values.forward, _Slopes.forward):
    # torch inspects the signature at every call, which takes longer than the evaluation of a few rows
    setattr(_function, "__signature__", inspect.signature(_function))  # noqa: B010 - no type knows of it


def _kept_slopes(ctx: Any, group: Group) -> Tensor:
    """The derivatives at a context's points; a Jacobian uses them for each of its rows."""
    found: Tensor | None = ctx.kept.get(group)
    if found is None:
        found = _slopes(ctx.evaluation, ctx.outputs, group, *ctx.saved_tensors)
        if not (found.requires_grad or is_wrapped(found)):
            ctx.kept[group] = found
    return found


def _over_batch(info: Any, in_dims: Any, function: Any, parts: tuple[Tensor, ...]) -> Tensor:
    """Evaluate a batch at once where its parameters are the same, else one problem after another."""
    size = info.batch_size
    first = [part if dim is None else part.movedim(dim, 0) for part, dim in zip(parts, in_dims, strict=True)]
    batched = [dim is not None for dim in in_dims]
    if batched[3]:
        each = [part.unbind(0) if many else [part] * size for part, many in zip(first, batched, strict=True)]
        return torch.stack([function(*problem) for problem in zip(*each, strict=True)])
    rows = [
        part.flatten(0, 1) if many else part.expand(size, *part.shape).flatten(0, 1)
        for part, many in zip(first[:3], batched[:3], strict=True)
    ]
    found: Tensor = function(*rows, first[3]).unflatten(0, (size, -1))
    return found


def _moments(time: Tensor, states: Tensor, inputs: Tensor, parameters: Tensor) -> EvaluationPoints:
    return EvaluationPoints(*(part.detach().cpu().double().numpy() for part in (time, states, inputs, parameters)))


def _tensor(values: Any, like: Tensor) -> Tensor:
    # a copy, because the values are cached and the caller may change them in place
    return torch.from_numpy(values.copy()).to(like)
