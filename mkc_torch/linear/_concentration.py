"""Concentration steps of every start of every problem in one kernel, for small problems of one channel on a GPU.

A program takes one start of one problem: residual, scale, weights, normal equations and solution stay in registers, and
the samples in the cache. In separate operations each of these would be read from and written to memory for all starts.
Everything is float64, whatever the type of the samples.
"""

from __future__ import annotations

from functools import lru_cache
from importlib.util import find_spec
from typing import TYPE_CHECKING, NamedTuple, Protocol

import torch
from torch import Tensor

from mkc_torch._support.torch_internals import is_wrapped

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

    from mkc_torch.losses.kernels.cached import CachedKernel

_MOST_COLUMNS = 12
"""Most columns: the normal equations are unrolled, and compile for seconds beyond."""

_MOST_SAMPLES = 4096
"""Most samples, all of which a program holds in registers."""

_VALUES = 72
"""Most values of X of a thread, which registers hold in part; a program of one warp needs no barriers."""

_LEAST_BLOCK = 64
"""Samples of a program, at least: two for each lane of a warp.

A lane's only product would be fused with the sum of the other lanes, so that lanes differ in the last digit and leave a
loop at different steps.
"""

_OWN_VALUES = 6
"""Values of a sample that a thread holds in addition to those of X."""

_MOST_WARPS = 16
"""Most warps of a program."""

QUANTILE, TRIMMED, M_SCALE = 0, 1, 2
"""Numbers of the scales in the kernel."""


class SmallProblem(Protocol):
    """What the kernels need of a :class:`LinearProblem`."""

    @property
    def basis(self) -> Float[Tensor, "#B N m n"]: ...

    @property
    def Y(self) -> Float[Tensor, "B N m"]: ...  # noqa: N802 - the name of LinearProblem

    @property
    def sample_weight(self) -> Float[Tensor, "B N m"] | None: ...

    @property
    def num_samples(self) -> int: ...

    @property
    def num_channels(self) -> int: ...

    @property
    def num_coefficients(self) -> int: ...


class ScaleOptions(NamedTuple):
    """Arguments of the kernel for a scale.

    Attributes:
        rule: :data:`QUANTILE`, :data:`TRIMMED` or :data:`M_SCALE`.
        rank: rank of the order statistic: the quantile, the number of values kept, or the first guess of an M-scale.
        c, breakdown, lost: constant of the bisquare, mean of ρ, and coefficients that its sum loses.
        newton: most Newton steps for an M-scale.
        exact: whether these solve for it to rounding.
    """

    rule: int
    rank: float
    c: float = 1.0
    breakdown: float = 0.5
    lost: float = 0.0
    newton: int = 0
    exact: bool = False


class ConcentrationResult(NamedTuple):
    """Coefficients, the scale at them, whether the last step did not lower it, and the number of steps."""

    beta: Float[Tensor, "B S n"]
    scale: Float[Tensor, "B S 1"]
    converged: Bool[Tensor, "B S"]
    n_iter: int


def runs_kernel(problem: SmallProblem) -> bool:
    """Whether concentration steps on this problem are one kernel: one channel, few columns and samples, on a GPU."""
    return problem.Y.is_cuda and suits_kernel(problem)


def suits_kernel(problem: SmallProblem) -> bool:
    """Whether the kernel takes problems of this size."""
    return (
        problem.num_samples > 1
        and problem.num_channels == 1
        and problem.num_coefficients <= _MOST_COLUMNS
        and problem.num_samples <= _MOST_SAMPLES
        and not is_wrapped(problem.Y)
        and find_spec("triton") is not None
    )


@lru_cache(maxsize=1)
def _kernels() -> tuple[CachedKernel, CachedKernel]:
    """Kernels of concentration steps and of weighted fits."""
    # these modules need Triton
    from mkc_torch.linear._concentration_kernel import concentration_kernel, weighted_fit_kernel
    from mkc_torch.losses.kernels.cached import CachedKernel

    return CachedKernel(concentration_kernel), CachedKernel(weighted_fit_kernel)


@lru_cache(maxsize=64)
def on_device(values: tuple[float, ...], device: torch.device) -> Float[Tensor, " k"]:
    """Numbers as a tensor, copied to the device once."""
    # the cached tensor outlives an inference mode in which it was created
    with torch.inference_mode(False):
        return torch.tensor(values, dtype=torch.float64, device=device)


class KernelData(NamedTuple):
    """Arguments of the kernels: columns, targets and sample weights with their numbers, and constants."""

    tensors: tuple[Tensor, Tensor, Tensor]
    numbers: tuple[int, int, int]
    columns: int
    block: int
    warps: int
    weighted: bool


def kernel_data(problem: SmallProblem) -> KernelData:
    kept: KernelData | None = problem.__dict__.get("_kept_data")
    if kept is not None:
        return kept
    columns = problem.basis.detach()[:, :, 0].mT.contiguous()
    y = problem.Y.detach().contiguous()
    weight = y if problem.sample_weight is None else problem.sample_weight.detach().contiguous()
    block = 1 << max(problem.num_samples - 1, _LEAST_BLOCK - 1).bit_length()
    kept = KernelData(
        (columns, y, weight),
        (problem.num_samples, 0 if columns.shape[0] == 1 else columns[0].numel(), weight[0].numel()),
        max(1 << (problem.num_coefficients - 1).bit_length(), 2),
        block,
        _warps(block * max(problem.num_coefficients, _OWN_VALUES)),
        problem.sample_weight is not None,
    )
    problem.__dict__["_kept_data"] = kept
    return kept


def _warps(values: int) -> int:
    """Warps of a program that holds so many values."""
    threads = -(-values // _VALUES)
    return min(1 << max(0, -(-threads // 32) - 1).bit_length(), _MOST_WARPS)


def concentrate(
    problem: SmallProblem,
    beta: Float[Tensor, "B S n"],
    options: ScaleOptions,
    *,
    near: Float[Tensor, "B S 1"] | None = None,
    max_iter: int = 0,
    tolerance: float = -torch.inf,
    keeps: bool = True,
) -> ConcentrationResult:
    """Make concentration steps from every start, each until its log scale falls by no more than ``tolerance``.

    ``near`` is the first guess of an M-scale at the starts; ``keeps``: the scale before a step is that after it.
    """
    count, starts, n = beta.shape
    given = kernel_data(problem)
    beta, near = beta.detach().contiguous(), None if near is None else near.detach().contiguous()
    found, scale = torch.empty_like(beta), beta.new_empty(count, starts, 1)
    steps = torch.empty(count, starts, dtype=torch.int32, device=beta.device)
    tiny = torch.finfo(torch.float64).tiny ** 0.5
    values = (options.rank, options.c, options.breakdown, options.lost, tolerance, tiny)
    _kernels()[0].launch(
        (count * starts, 1, 1),
        (
            *given.tensors, beta, scale if near is None else near, on_device(values, beta.device), found, scale, steps,
        ),
        (
            starts, *given.numbers, max_iter,
            int(near is not None), int(keeps), options.newton, int(options.exact),
        ),
        (n, given.columns, given.block, options.rule, given.weighted),
        given.warps,
    )  # fmt: skip
    most = int(torch.where(steps < 0, -steps - 1, steps).max()) if max_iter > 0 and tolerance > -torch.inf else max_iter
    return ConcentrationResult(found, scale, steps >= 0, most)


def weighted_fits(problem: SmallProblem, weight: Float[Tensor, "B S N 1"]) -> Float[Tensor, "B S n"]:
    """Weighted least-squares coefficients in the basis; the coefficient of a direction without weight is 0."""
    count, sets = weight.shape[:2]
    given, n = kernel_data(problem), problem.num_coefficients
    found = weight.new_empty(count, sets, n)
    _kernels()[1].launch(
        (count * sets, 1, 1),
        (*given.tensors, weight.detach().contiguous(), found),
        (sets, *given.numbers),
        (n, given.columns, given.block, given.weighted),
        given.warps,
    )
    return found
