"""Forward and backward pass of :class:`mkc_torch.MKCLoss` by kernels: two or three launches, and a single launch."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from mkc_torch._support.torch_internals import in_backward
from mkc_torch.losses._parameters import ChannelState
from mkc_torch.losses._terms import Batch, LossSettings, loss_value
from mkc_torch.losses.kernels.channels import TABLE
from mkc_torch.losses.kernels.launch import (
    Arranged,
    Options,
    Running,
    arranged,
    make_table,
    pass_over,
    reduce_batch,
    rescale,
    weight_sums,
)
from mkc_torch.losses.residual_scale import ScaleState, average_over_processes, is_distributed, synchronized_state


class ChannelPass(NamedTuple):
    """State of a forward pass for its backward pass, in addition to the saved tensors."""

    weight: Tensor | None
    axis: int
    table: Tensor
    options: Options
    fixed_kappa: Tensor | None
    fixed_d: Tensor | None
    reduction: str

    def settings(self) -> LossSettings:
        """Settings of the differentiable formulas, from the table."""
        rows = dict(zip(TABLE, self.table, strict=True))
        robust, has_scale = self.options.robust, self.options.has_scale
        state = ChannelState(
            rows["bound"],
            rows["floor"],
            rows["scale"] if has_scale else None,
            rows["log_bandwidth"] if robust else None,
            rows["share"] if robust else None,
        )
        reduction: Any = self.reduction
        return LossSettings(
            self.fixed_kappa, self.fixed_d, state, self.options.follows, self.options.normalize, reduction
        )

    def value_by_formulas(
        self, input: Tensor, target: Tensor, raw_kappa: Tensor | None, raw_d: Tensor | None
    ) -> Tensor:
        """The loss as a differentiable function of its inputs, at the state of this forward pass."""
        dtype = self.table.dtype
        counts = None if self.weight is None else self.weight != 0
        weight = None if self.weight is None else self.weight.to(dtype)
        return loss_value(
            Batch(input.to(dtype), target.to(dtype), weight, counts, self.axis), raw_kappa, raw_d, self.settings()
        )


def options_of(loss: Any) -> Options:
    """Options of a loss in its current mode."""
    scale, schedule = loss._running()
    robust = loss.training and schedule is not None
    buffers, parameters = loss._buffers, loss._parameters
    return Options(
        follows=loss._follows,
        robust=robust,
        has_scale=scale is not None and (loss._follows or robust),
        learn_kappa=parameters.get("raw_kappa") is not None,
        learn_d=parameters.get("raw_d") is not None,
        own_bound=buffers.get("fixed_bound") is not None,
        own_floor=buffers.get("fixed_d_min") is not None,
        normalize=loss.normalize,
        mean=loss.reduction == "mean",
    )


@torch.no_grad()
def prepared(
    loss: Any, input: Tensor, target: Tensor, weight: Tensor | None, axis: int
) -> tuple[Arranged, ChannelPass]:
    """Update the running state in training, and fill the table."""
    options, batch = options_of(loss), arranged(input.detach(), target.detach(), weight, axis)
    request = request_of(loss, input.device)
    table = updated_table(batch, request, options, updates=request.updates and not in_backward())
    buffers = loss._buffers
    fixed = (buffers.get("fixed_kappa"), buffers.get("fixed_d"))
    return batch, ChannelPass(weight, axis, table, options, *fixed, loss.reduction)


class KernelRequest(NamedTuple):
    """Arguments of the channel kernel from a loss."""

    kappa: Tensor
    d: Tensor | None
    bound: Tensor | None
    floor: Tensor | None
    running: Running
    updates: bool
    warmup_steps: int
    anneal_step: float


def request_of(loss: Any, device: torch.device) -> KernelRequest:
    """The parameters and buffers of a loss."""
    scale, schedule = loss._running()
    parameters, buffers = loss._parameters, loss._buffers
    kappa, d = parameters.get("raw_kappa"), parameters.get("raw_d")
    kappa = buffers.get("fixed_kappa") if kappa is None else kappa
    d = buffers.get("fixed_d") if d is None else d
    assert kappa is not None
    running, pace = Running(), (0, 0.0)
    if scale is not None:
        own = scale._buffers
        if own["log_scale"].device != device:
            scale.to(device)  # a guide is not a submodule of the loss, and is not moved with it
        running = Running(*(own[name] for name in Running._fields[:5]))
        if schedule is not None:
            others = schedule._buffers
            if others["share"].device != device:
                schedule.to(device)
            running = Running(*running[:5], *(others[name] for name in Running._fields[5:]))
            pace = (schedule.warmup_steps, schedule.anneal_step)
    given = (kappa, d, buffers.get("fixed_bound"), buffers.get("fixed_d_min"))
    return KernelRequest(*given, running, scale is not None and loss.training, *pace)


def updated_table(batch: Arranged, request: KernelRequest, options: Options, *, updates: bool) -> Tensor:
    """The table of the numbers of each channel, after an update of the running state if ``updates``."""
    running, numbers, pace = request.running, request[:4], request[-2:]
    scheduled = updates and running.share is not None
    if not (updates and is_distributed()):
        peek = options.has_scale and not updates
        return make_table(
            batch, running, *numbers, options, scale=updates, peek=peek, schedule=scheduled, table=True, pace=pace
        )
    make_table(batch, running, *numbers, options, scale=True, table=False, pace=pace)
    state = ScaleState(running.batches, running.log_scale, running.half_range)
    for own, joined in zip(state, synchronized_state(state), strict=True):
        own.copy_(joined)
    if scheduled:
        make_table(batch, running, *numbers, options, schedule=True, table=False, pace=pace)
        own_schedule = [value for value in (running.log_bandwidth, running.share) if value is not None]
        for own, mean in zip(own_schedule, average_over_processes(own_schedule), strict=True):
            own.copy_(mean)
    return make_table(batch, running, *numbers, options, pace=pace)


class ReducedFunction(torch.autograd.Function):
    """A sum or mean.

    The forward pass computes the gradient with respect to the input. In float16 the backward pass does: 1 over the
    number of elements would underflow before a gradient scaler multiplies it.
    """

    @staticmethod
    def forward(
        ctx: Any, input: Tensor, target: Tensor, raw_kappa: Any, raw_d: Any, batch: Arranged, work: ChannelPass
    ) -> Tensor:
        wants = ctx.needs_input_grad
        ctx.stores = (wants[0] or wants[1]) and input.dtype != torch.float16
        value, *ctx.found = reduce_batch(batch, work.table, work.options, wants_input=ctx.stores)
        ctx.save_for_backward(input, target, raw_kappa, raw_d)
        ctx.work = work
        return value

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        if torch.is_grad_enabled():
            return (*_by_formulas(ctx, grad), None, None)
        found, ctx.found = ctx.found, None
        work, wants = ctx.work, ctx.needs_input_grad
        if found is None:  # a second backward pass of the same graph
            found = reduce_batch(_again(ctx), work.table, work.options, wants_input=ctx.stores)[1:]
        slopes, by_kappa, by_d = found
        rescale(slopes, by_kappa, by_d, grad)
        if slopes is None and (wants[0] or wants[1]):
            batch = _again(ctx)
            slopes = torch.empty_like(batch.input)
            weights, total = weight_sums(batch, work.table.dtype)
            pass_over(
                batch, work.table, work.options, weights=weights, total_weight=total, upstream=grad, slopes=slopes
            )
        return (*_handed_out(ctx, slopes), by_kappa, by_d, None, None)


class EachFunction(torch.autograd.Function):
    """The loss of each element. The backward pass computes the gradients, because it needs the upstream gradient."""

    @staticmethod
    def forward(
        ctx: Any, input: Tensor, target: Tensor, raw_kappa: Any, raw_d: Any, batch: Arranged, work: ChannelPass
    ) -> Tensor:
        ctx.save_for_backward(input, target, raw_kappa, raw_d)
        ctx.work = work
        values = torch.empty_like(batch.input, dtype=work.table.dtype)
        pass_over(batch, work.table, work.options, values=values)
        return values

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        if torch.is_grad_enabled():
            return (*_by_formulas(ctx, grad), None, None)
        work: ChannelPass = ctx.work
        slopes, by_kappa, by_d = gradients_of_each(_again(ctx), work.table, work.options, grad)
        return (*_handed_out(ctx, slopes), by_kappa, by_d, None, None)


def _again(ctx: Any) -> Arranged:
    """The batch from the saved tensors; keeping it in ``ctx`` would not free it with the graph."""
    input, target, *_ = ctx.saved_tensors
    return arranged(input.detach(), target.detach(), ctx.work.weight, ctx.work.axis)


def gradients_of_each(
    batch: Arranged, table: Tensor, options: Options, grad: Tensor
) -> tuple[Tensor, Tensor | None, Tensor | None]:
    """Gradients with respect to the input and the raw parameters, with an upstream gradient per element."""
    slopes = torch.empty_like(batch.input)
    by_kappa = table.new_empty(batch.channels) if options.learn_kappa else None
    by_d = table.new_empty(batch.channels) if options.learn_d else None
    pass_over(
        batch, table, options, upstream=grad, slopes=slopes, by_kappa=by_kappa, by_d=by_d,
        sums=options.learn_kappa or options.learn_d,
    )  # fmt: skip
    return slopes, by_kappa, by_d


def _handed_out(ctx: Any, slopes: Tensor | None) -> tuple[Tensor | None, Tensor | None]:
    """The gradients with respect to input and target, in their dtypes."""
    target = ctx.saved_tensors[1]
    wants = ctx.needs_input_grad
    by_target = -slopes.to(target.dtype) if wants[1] and slopes is not None else None
    return slopes if wants[0] else None, by_target


def _by_formulas(ctx: Any, grad: Tensor) -> list[Tensor | None]:
    """Differentiable gradients, for second derivatives."""
    given = ctx.saved_tensors
    value = ctx.work.value_by_formulas(*given)
    wanted = [entry for entry, wants in zip(given, ctx.needs_input_grad, strict=False) if wants]
    found = iter(torch.autograd.grad(value, wanted, grad.to(value.dtype), create_graph=True))
    return [next(found) if wants else None for wants in ctx.needs_input_grad[:4]]
