"""Compile the kernels of the losses and of large fits for a GPU, on a machine with or without a GPU.

    python -m tests.losses.kernels.compilation

The interpreter runs what the compiler refuses: variables that change their type in a branch or a loop, numbers that are
1 and so become constants. Losses run here on the CPU with launches recorded in place of being run, so that each is
compiled with the dtypes, alignments and flags that it has.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import torch
import triton
from torch import Tensor
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource

from mkc_torch import GeneralizedCrossEntropyLoss, HeteroscedasticMKCLoss, MKCLoss
from mkc_torch.density.likelihood import DensityState
from mkc_torch.linear._alternation import alternate_by_kernel
from mkc_torch.linear._blocks import Density
from mkc_torch.linear._concentration import concentrate, weighted_fits
from mkc_torch.linear._fused_pass import fused_pass
from mkc_torch.linear._problem import linear_problem
from mkc_torch.linear.least_trimmed_squares import TrimmedScale
from mkc_torch.linear.s_regression import MScale
from mkc_torch.losses.kernels.cached import CachedKernel

TARGET = GPUTarget("cuda", 90, 32)
"""An H100."""

_TYPES = {
    torch.float16: "*fp16", torch.bfloat16: "*bf16", torch.float32: "*fp32", torch.float64: "*fp64",
    torch.bool: "*i1", torch.uint8: "*u8", torch.int32: "*i32", torch.int64: "*i64",
}  # fmt: skip


def compiled(kernel: Any, tensors: Any, numbers: Any, constants: Any, warps: int) -> Any:
    """The kernel compiled by Triton for this launch."""
    given = (*tensors, *numbers, *constants)
    signature, constant, attributes = {}, {}, {}
    for place, (name, value) in enumerate(zip(kernel.arg_names, given, strict=True)):
        if place >= len(tensors) + len(numbers) or (not isinstance(value, Tensor) and value == 1):
            signature[name], constant[(place,)] = "constexpr", value
            continue
        if isinstance(value, Tensor):
            signature[name], aligned = _TYPES[value.dtype], True
        else:
            signature[name] = "fp32" if isinstance(value, float) else "i64" if abs(value) >= 2**31 else "i32"
            aligned = isinstance(value, int) and value % 16 == 0
        if aligned:
            attributes[(place,)] = [["tt.divisibility", 16]]
    source = ASTSource(kernel, signature, constant, attributes)
    return triton.compile(source, target=TARGET, options={"num_warps": warps})


def fuses_lanes(ptx: str) -> bool:
    """Whether a fused multiply-add uses a value of another lane, so that sums differ between lanes."""
    shuffled: set[str] = set()
    for line in ptx.splitlines():
        if found := re.search(r"shfl\.sync\.\w+\.b32\s+(%r\d+)", line):
            shuffled.add(found[1])
        elif found := re.search(r"(?:cvt\.u64\.u32|shl\.b64|or\.b64|mov\.b\d+)\s+(%\w+),(.*);", line):
            if shuffled & set(re.findall(r"%\w+", found[2])):
                shuffled.add(found[1])
        elif (found := re.search(r"fma\.rn\.f\d+\s+%\w+, %\w+, %\w+, (%\w+);", line)) and found[1] in shuffled:
            return True
    return False


def training_steps() -> Iterator[str]:
    """Forward and backward passes of losses, by name."""

    def samples(name: str, dtype: torch.dtype, *, weighted: bool = False, each: bool = False, **options: Any) -> str:
        leaves = [torch.ones(64, 16, 3, dtype=dtype, requires_grad=True) for _ in range(4)]
        weight = torch.ones(64, 16, 3, dtype=torch.bool) if weighted else None
        bound = torch.full((16 if each else 1,), 9.0, dtype=torch.float64 if dtype == torch.float64 else torch.float32)
        loss = HeteroscedasticMKCLoss(bound if each else bound[0], channel_dim=1, impl="triton", **options)
        loss(*leaves, weight).sum().backward()
        return f"samples, {name}"

    yield samples("float32", torch.float32)
    yield samples("bfloat16, weighted, bounds of channels", torch.bfloat16, weighted=True, each=True)
    yield samples("float16", torch.float16, reduction="sum")
    yield samples("float64, each", torch.float64, reduction="none")

    def labels(name: str, shape: tuple[int, int], dtype: torch.dtype, *, weighted: bool = False, **options: Any) -> str:
        logits = torch.zeros(shape, dtype=dtype, requires_grad=True)
        weight = torch.ones(shape[1]) if weighted else None
        target = torch.zeros(shape[0], dtype=torch.uint8 if shape[1] < 256 else torch.int64)
        GeneralizedCrossEntropyLoss(impl="triton", weight=weight, **options)(logits, target).sum().backward()
        return f"labels, {name}"

    def channels(
        name: str, shape: tuple[int, ...], dtype: torch.dtype, *, axis: int = -1, weighted: bool = False, **options: Any
    ) -> str:
        x, y = torch.zeros(shape, dtype=dtype, requires_grad=True), torch.ones(shape, dtype=dtype)
        loss = MKCLoss(shape[axis], channel_dim=axis, impl="triton", **options)
        loss = loss.double() if dtype == torch.float64 else loss
        loss(x, y, torch.ones(shape, dtype=torch.bool) if weighted else None).sum().backward()
        return f"channels, {name}"

    yield channels("float32", (1 << 15, 4), torch.float32)
    yield channels("given d, one small batch", (64, 1), torch.float32, d=1.0)
    yield channels("float64, seven channels, weighted", (5000, 7), torch.float64, weighted=True)
    yield channels("images", (2, 3, 64, 64), torch.bfloat16, axis=1, d=1.0, reduction="none")
    yield channels("float16", (1 << 15, 4), torch.float16, d=1.0, learn_sigma=False, learn_d=False)
    yield labels("float32", (256, 1000), torch.float32)
    yield labels("bfloat16, weighted, many rows", (3000, 10), torch.bfloat16, weighted=True)
    yield labels("float16, many classes", (2, 5000), torch.float16)
    yield labels("float64, each", (16, 3), torch.float64, reduction="none")

    def rows(name: str, dtype: torch.dtype, columns: int, *, curvature: bool) -> str:
        X, density = torch.ones(4096, columns, dtype=dtype), Density(*torch.ones(2, 1, dtype=torch.float64))
        y, beta = torch.ones(4096, dtype=dtype), torch.ones(columns, dtype=torch.float64)
        fused_pass(X, y, y, beta, density, with_curvature=curvature, weights=y[:, None].clone())
        return f"rows, {name}"

    def starts(name: str, samples: int, columns: int, rule: MScale | TrimmedScale, *, weighted: bool = False) -> str:
        X = torch.eye(samples, columns, dtype=torch.float64) + 1.0
        y = torch.ones(samples, dtype=torch.float64)
        problem = linear_problem(X, y, y if weighted else None)
        beta, near = torch.ones(1, 16, columns, dtype=torch.float64), torch.ones(1, 16, 1, dtype=torch.float64)
        options = {"near": near, "tolerance": 1e-7} if isinstance(rule, MScale) else {}
        concentrate(problem, beta, rule.options(problem), max_iter=20, **options)
        return f"starts, {name}"

    def fits(name: str, samples: int, columns: int) -> str:
        X, y = torch.eye(samples, columns, dtype=torch.float64) + 1.0, torch.ones(samples, dtype=torch.float64)
        weighted_fits(linear_problem(X, y, y), torch.ones(1, 3, samples, 1, dtype=torch.float64))
        return f"fits, {name}"

    def alternations(name: str, samples: int, columns: int, *, weighted: bool = False) -> str:
        X, y = torch.eye(samples, columns, dtype=torch.float64) + 1.0, torch.ones(samples, dtype=torch.float64)
        problem, one = linear_problem(X, y, y if weighted else None), torch.ones(1, 1, dtype=torch.float64)
        state = DensityState(one, one, one, one, one, one)
        alternate_by_kernel(
            problem, torch.ones(1, columns, dtype=torch.float64), state, max_iter=20, tol=1e-10, patience=2
        )
        return f"alternations, {name}"

    yield alternations("two columns", 100, 2)
    yield alternations("two columns, few samples", 25, 2)
    yield alternations("nine columns, weighted", 500, 9, weighted=True)
    yield fits("six columns, weighted", 300, 6)
    yield starts("two columns, M-scale", 100, 2, MScale(30))
    yield starts("two columns, few samples, M-scale", 25, 2, MScale(30))
    yield starts("six columns, trimmed", 300, 6, TrimmedScale(0.5))
    yield starts("twelve columns, many weighted samples", 1500, 12, MScale(2), weighted=True)
    yield rows("float32, nine columns", torch.float32, 9, curvature=False)
    yield rows("float64, nine columns, curvature", torch.float64, 9, curvature=True)
    yield rows("float32, 32 columns, curvature", torch.float32, 32, curvature=True)


def main() -> None:
    """Compile every launch and print whether it has vector loads of four numbers, and whether lanes agree on sums."""
    launches: list[tuple[Any, ...]] = []

    def launch(self: CachedKernel, grid: Any, *arguments: Any) -> None:
        launches.append((self.kernel, *arguments))

    CachedKernel.launch = launch  # type: ignore[method-assign]
    for name in training_steps():
        for kernel, *arguments in launches:
            found = compiled(kernel, *arguments)
            loads = "ld.global.v4" if ".v4.b32" in found.asm["ptx"] else "narrow loads"
            lanes = "lanes may differ" if fuses_lanes(found.asm["ptx"]) else "lanes agree"
            print(f"{name}: {kernel.__name__}, {loads}, {lanes}", flush=True)
        launches.clear()


if __name__ == "__main__":
    main()
