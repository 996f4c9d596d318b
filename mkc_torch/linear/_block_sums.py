"""The sums of a pass over blocks of rows, in memory that all blocks share.

Fresh memory for every operation takes as long as the operation. On a CPU the operations are NumPy's, several of which
take half as long as torch's.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from mkc_torch.density.energy import energy_terms
from mkc_torch.linear._blocks import Block, CurvatureSums, Density, PassResult, ResidualRange, Sums
from mkc_torch.linear.summary import LIGHT

if TYPE_CHECKING:
    from jaxtyping import Float, Float64

_STRIP = 1 << 13
"""Rows whose products are formed at once, at most; four times as many take three times as long."""

_SERIAL = (1 << 15) - 1
_SERIAL_PRODUCTS = 1 << 18
_SERIAL_DOT = 10_000
"""Values that torch multiplies, products of a matrix product and rows of a scalar product up to which torch and
OpenBLAS start no threads: two pools of threads wait for one another, and for other programs on a busy machine."""

_FEWEST = 1 << 10
"""Rows of a strip at least, so that adding its products costs less than forming them."""

PLAIN_KAPPA = 1e-2
"""κ from which differences of sums over κ and κ² lose at most four digits, so that three sums give all derivatives."""


_LARGEST = 1e15
"""Limit of q in float32, whose square is finite."""


class Memory:
    """Tensors by name that keep their memory from block to block and from batch to batch.

    Example:
        >>> memory = Memory()
        >>> memory.of("x", (3,)).data_ptr() == memory.of("x", (2, 1)).data_ptr()
        True
    """

    def __init__(self) -> None:
        self._held: dict[tuple[str, torch.device, torch.dtype], Tensor] = {}

    def of(
        self,
        name: str,
        shape: tuple[int, ...],
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float64,
    ) -> Tensor:
        """A tensor of this shape; its values are arbitrary, and lost at the next call with the same name."""
        key, size = (name, torch.device(device), dtype), math.prod(shape)
        held = self._held.get(key)
        if held is None or held.numel() < size:
            held = self._held[key] = torch.empty(size, dtype=dtype, device=device)
        return held[:size].view(shape)


def products(
    rows: Float64[Tensor, "k n"],
    others: Float64[Tensor, "k j"],
    weight: Float64[Tensor, " k"] | None = None,
    memory: Memory | None = None,
) -> Float64[Tensor, "n j"]:
    """Sum of weight · rowᵀ · other row."""
    if rows.device.type != "cpu":
        return torch.matmul((rows if weight is None else rows * weight.unsqueeze(-1)).mT, others)
    memory = Memory() if memory is None else memory
    total = np.zeros((rows.shape[1], others.shape[1]))
    n, j = rows.shape[1], others.shape[1]
    step = min(max(_SERIAL // n, _FEWEST), max(_SERIAL_PRODUCTS // (n * j), _FEWEST), _STRIP)
    for first in range(0, rows.shape[0], step):
        part = slice(first, first + step)
        strip = rows[part]
        if weight is not None:
            # torch multiplies rows of few columns by a weight five times as fast as NumPy
            strip = torch.mul(strip, weight[part].unsqueeze(-1), out=memory.of("strip", tuple(strip.shape)))
        total += strip.numpy().T @ others[part].numpy()
    return torch.from_numpy(total)


def _same(value: Tensor) -> Tensor:
    return value


class BlockSums:
    """Accumulates the sums of a pass at a point.

    Args:
        beta, density: the point, on the CPU.
        memory: memory for intermediate results.
        device: device of the blocks.
        dtype: float32 for blocks of float32 arrays without curvature, whose products are formed in float32.
        with_curvature: whether to form the curvature sums too.
        with_range: whether to find the range of the residuals.
    """

    def __init__(
        self,
        beta: Float64[Tensor, " n"],
        density: Density,
        memory: Memory,
        device: torch.device,
        dtype: torch.dtype = torch.float64,
        *,
        with_curvature: bool,
        with_range: bool,
    ) -> None:
        m, n = len(density.kappa), len(beta)
        self._on_cpu = device.type == "cpu"
        self._operations: Any = np if self._on_cpu else torch
        # a number on a GPU stays there
        self._number: Any = float if self._on_cpu else _same
        self._device, self._dtype, self._memory = device, dtype, memory
        self._beta = self._native(beta.to(device, dtype))
        self._kappa, self._precision = density.kappa.tolist(), density.d.pow(-2).tolist()
        self._with_curvature, self._with_range = with_curvature, with_range
        # weight, residual and terms
        self._channels = self._zeros(7, m)
        self._low, self._high = self._zeros(m) + math.inf, self._zeros(m) - math.inf
        self._score, self._tilt, self._moment = (self._zeros(m, n) for _ in range(3))
        self._square, self._light = self._zeros(m), self._zeros(1)
        self._curvature, self._spread = (torch.zeros(n, n, dtype=torch.float64, device=device) for _ in range(2))

    def add(self, block: Block, weights: Float[Tensor, "b m"] | None = None) -> None:
        """Add the sums of a block; write the weights of the density to ``weights``."""
        count, m, _ = block.rows.shape
        for c in range(m):
            own = None if block.weight is None else self._native(block.weight[:, c])
            self._channels[0, c] += count if own is None else self._number(own.sum())
            # the weight of a residual whose square overflows is 0
            with np.errstate(over="ignore"):
                self._add_channel(c, block.rows[:, c], self._native(block.y[:, c]), own, weights)
        if self._with_curvature and m > 1:
            scored = self._memory.of("scored", (count, block.rows.shape[2]), self._device)
            self._spread += products(scored, scored)

    def result(self) -> PassResult:
        """The sums of all blocks, on the CPU."""
        weight, residual, *terms = self._tensor(self._channels)
        more = None
        if self._with_curvature:
            found = (self._tilt, self._moment, self._square, self._light)
            more = CurvatureSums(self._curvature.cpu(), self._spread.cpu(), *map(self._tensor, found))
        extent = ResidualRange(self._tensor(self._low), self._tensor(self._high)) if self._with_range else None
        return PassResult(Sums(weight, residual, torch.stack(terms), self._tensor(self._score)), more, extent)

    def _add_channel(
        self, c: int, rows: Float64[Tensor, "b n"], y: Any, own: Any, weights: Float[Tensor, "b m"] | None
    ) -> None:
        do, kappa, precision = self._operations, self._kappa[c], self._precision[c]
        count, x = len(y), self._native(rows)
        vectors = self._memory.of("vectors", (5, count), self._device, self._dtype)
        e, q, w, s, t = map(self._native, vectors)
        do.matmul(x, self._beta, out=e)
        do.subtract(y, e, out=e)
        do.multiply(e, e, out=q)
        q *= 0.5 * precision
        if self._dtype == torch.float32:
            # an infinite square times the weight 0 would be NaN
            do.minimum(q, np.float32(_LARGEST), out=q)
        do.multiply(q, -kappa, out=w)
        do.exp(w, out=w)
        if weights is not None:
            weights[:, c] = vectors[2]
        if self._with_range:
            low, high = (e, e) if own is None else (do.where(own > 0, e, math.inf), do.where(own > 0, e, -math.inf))
            if self._dtype == torch.float64:
                least, largest = low.min(), high.max()
            else:
                least, largest = (self._exact(x, y, row) for row in (low.argmin(), high.argmax()))
            self._low[c] = do.minimum(self._low[c], least)
            self._high[c] = do.maximum(self._high[c], largest)
        if self._with_curvature:
            self._light += do.count_nonzero(w < LIGHT)
        if own is not None:
            w *= own
        do.multiply(w, e, out=s)
        do.multiply(s, q, out=t)
        qw, q2w = (0.5 * precision * self._number(self._dot(v, e)) for v in (s, t))
        residual = self._number(e.sum() if own is None else self._dot(own, e))
        energy = self._energy(c, vectors[1], w, own, qw, q2w)
        for row, value in enumerate((residual, *energy, qw, q2w), 1):
            self._channels[row, c] += value
        # the error of a sum in float32 grows with its rows
        step = count if self._dtype == torch.float64 else _STRIP
        for first in range(0, count, step):
            self._score[c] += do.matmul(s[first : first + step], x[first : first + step])
        if self._with_curvature:
            self._tilt[c] += do.matmul(t, x)
            self._add_curvature(c, rows, vectors, own)

    def _exact(self, x: Any, y: Any, row: Any) -> float:
        """The residual of a row in float64, so that the domain does not depend on how rows are cut into blocks."""
        return float(y[row]) - float(np.dot(x[row].astype(np.float64), self._beta.astype(np.float64)))

    def _energy(self, c: int, q: Tensor, w: Any, own: Any, qw: Any, q2w: Any) -> Any:
        """Sums of the energy and of the terms of its first and second derivative by κ."""
        kappa = self._kappa[c]
        if kappa >= PLAIN_KAPPA:
            total = len(w) if own is None else self._number(own.sum())
            value = (total - self._number(w.sum())) / kappa
            first = (value - qw) / kappa
            return value, first, (2.0 * first - q2w) / kappa
        # limited, since the cube of q would overflow
        every = torch.stack(energy_terms(q.clamp(max=1e100), q.new_tensor(kappa))[1:])
        return self._native(every.sum(-1)) if own is None else self._operations.matmul(self._native(every), own)

    def _add_curvature(self, c: int, rows: Float64[Tensor, "b n"], vectors: Float64[Tensor, "5 b"], own: Any) -> None:
        do, precision = self._operations, self._precision[c]
        e, q, w, s, t = map(self._native, vectors)
        q *= -2.0 * self._kappa[c]
        q += 1.0
        q *= w
        q *= precision
        self._curvature += products(rows, rows, vectors[1], self._memory)
        s *= precision
        if len(self._kappa) == 1:
            do.multiply(s, s, out=t)
            self._spread += products(rows, rows, vectors[4], self._memory)
        else:
            scored = self._memory.of("scored", tuple(rows.shape), self._device)
            _ = scored.zero_() if c == 0 else None
            scored.addcmul_(rows, vectors[3].unsqueeze(-1))
        plain = e if own is None else do.multiply(own, e, out=t)
        self._moment[c] += do.matmul(plain, self._native(rows))
        self._square[c] += self._dot(plain, e)

    def _dot(self, values: Any, others: Any) -> Any:
        do, count = self._operations, len(values)
        step = _SERIAL_DOT if self._on_cpu else max(count, 1)
        return sum(do.dot(values[k : k + step], others[k : k + step]) for k in range(0, count, step))

    def _native(self, values: Any) -> Any:
        return values.numpy() if self._on_cpu and isinstance(values, Tensor) else values

    def _zeros(self, *shape: int) -> Any:
        return self._native(torch.zeros(shape, dtype=torch.float64, device=self._device))

    def _tensor(self, values: Any) -> Tensor:
        return torch.from_numpy(values) if self._on_cpu else values.cpu()
