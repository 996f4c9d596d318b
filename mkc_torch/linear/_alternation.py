"""The alternation of MKC-EM as one kernel for many small problems of one channel on a GPU.

In separate operations each alternation is a hundred launches, which take longer than their work on some thousand
problems. Everything is float64, whatever the type of the samples.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from mkc_torch.density._numpy_newton import KAPPA_OFFSET, LEAST_KAPPA_SHARE, LONGEST_STEP
from mkc_torch.density.energy import KAPPA_MAX
from mkc_torch.density.head import HEAD_TOLERANCE, head_rule_constants
from mkc_torch.linear._concentration import SmallProblem, kernel_data, on_device

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

    from mkc_torch.density.likelihood import DensityState
    from mkc_torch.losses.kernels.cached import CachedKernel

_STEPS = 12
"""Alternations of a launch; the host looks after each whether all problems have ended."""

_FIELDS = ("kappa", "log_d", "log_bound", "log_d_min", "damping", "value")
"""Fields of the density's state in the order of the kernel."""


class AlternationResult(NamedTuple):
    """Coefficients, the density's state, which problems ended, and the values at the start and after each step."""

    beta: Float[Tensor, "B n"]
    state: DensityState
    ended: Bool[Tensor, " B"]
    history: list[Float[Tensor, " B"]]


@lru_cache(maxsize=1)
def _kernel() -> CachedKernel:
    # these modules need Triton
    from mkc_torch.linear._alternation_kernel import alternation_kernel
    from mkc_torch.losses.kernels.cached import CachedKernel

    return CachedKernel(alternation_kernel)


def alternate_by_kernel(
    problem: SmallProblem,
    beta: Float[Tensor, "B n"],
    state: DensityState,
    *,
    max_iter: int,
    tol: float,
    patience: int,
) -> AlternationResult:
    """Alternate until ``patience`` alternations of a problem gain no more than ``tol`` and rounding."""
    given, count, device = kernel_data(problem), beta.shape[0], beta.device
    numbers = torch.zeros(len(_FIELDS) + 3, count, dtype=torch.float64, device=device)
    for row, name in zip(numbers, _FIELDS, strict=False):
        row.copy_(getattr(state, name).expand(count, 1)[:, 0])
    coef = beta.double().contiguous().clone()
    history = [numbers[5].clone()]
    rounding = 8 * torch.finfo(beta.dtype).eps
    nodes, weights = (tuple(part.tolist()) for part in head_rule_constants())
    constants = on_device((*nodes, *weights), device), on_device((tol, rounding), device)
    while len(history) <= max_iter:
        steps = min(_STEPS, max_iter + 1 - len(history))
        values = torch.empty(steps, count, dtype=torch.float64, device=device)
        _kernel().launch(
            (count, 1, 1),
            (*given.tensors, *constants, coef, numbers, values),
            (count, *given.numbers, steps, patience, int(state.free_kappa), int(state.free_d)),
            (
                problem.num_coefficients, given.columns, given.block, given.weighted, len(nodes), HEAD_TOLERANCE,
                KAPPA_MAX, KAPPA_OFFSET, LONGEST_STEP, LEAST_KAPPA_SHARE,
            ),
            given.warps,
        )  # fmt: skip
        history += values
        if bool(numbers[7].all()):
            break
    made = int(numbers[8].max())
    fields = {name: row.unsqueeze(-1).to(beta.dtype) for name, row in zip(_FIELDS, numbers, strict=False)}
    ended = (numbers[7] > 0) & torch.isfinite(numbers[5])
    return AlternationResult(
        coef.to(beta.dtype), replace(state, **fields), ended, [entry.to(beta.dtype) for entry in history[: made + 1]]
    )
