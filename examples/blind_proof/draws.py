"""Random numbers of the blind proof, from generators that are seeded by the address of a case."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, TypeVar

import torch
from torch import Generator, Tensor

if TYPE_CHECKING:
    from jaxtyping import Float

Choice = TypeVar("Choice")


def generator(*address: int | str) -> Generator:
    """Return a separate generator for each address, such as ``(seed, index, "noise")``.

    Example:
        >>> bool(normal(generator(1, 2), 1) == normal(generator(1, 2), 1))
        True
    """
    digest = hashlib.sha256("/".join(map(str, address)).encode()).digest()
    # torch's CPU generator uses 32 bits of the seed
    return Generator().manual_seed(int.from_bytes(digest[:4], "big"))


def uniform(g: Generator, low: float, high: float) -> float:
    return low + (high - low) * float(torch.rand((), generator=g, dtype=torch.float64))


def log_uniform(g: Generator, low: float, high: float) -> float:
    return math.exp(uniform(g, math.log(low), math.log(high)))


def happens(g: Generator, share: float) -> bool:
    return uniform(g, 0.0, 1.0) < share


def whole(g: Generator, low: int, high: int) -> int:
    """Draw an integer from ``low`` to ``high``, both included."""
    return int(torch.randint(low, high + 1, (), generator=g))


def choose(g: Generator, options: Sequence[Choice], shares: Sequence[float] | None = None) -> Choice:
    weights = torch.ones(len(options)) if shares is None else torch.tensor(shares)
    return options[int(torch.multinomial(weights.double(), 1, generator=g))]


def normal(g: Generator, *shape: int) -> Tensor:
    return torch.randn(shape, generator=g, dtype=torch.float64)


def direction(g: Generator) -> Float[Tensor, " 3"]:
    """Draw a unit vector, uniformly on the sphere."""
    return torch.nn.functional.normalize(normal(g, 3), dim=0)


def unit_variance(g: Generator, family: str, *shape: int) -> Tensor:
    """Draw independent errors of variance 1: ``gaussian``, ``laplace`` or ``student`` with five degrees of freedom.

    Example:
        >>> bool(abs(unit_variance(generator(0), "laplace", 20000).var() - 1) < 0.05)
        True
    """
    z = normal(g, *shape)
    if family == "gaussian":
        return z
    if family == "laplace":
        # a normal variable with an exponential variance
        rate = -torch.log1p(-torch.rand(shape, generator=g, dtype=torch.float64))
        return z * rate.sqrt()
    if family == "student":
        chi2 = normal(g, 5, *shape).square().sum(0)
        return z * (5.0 / chi2).sqrt() * math.sqrt(3.0 / 5.0)
    raise ValueError(f"Expected the family to be gaussian, laplace or student but got {family!r}.")


def smooth(g: Generator, samples: int, columns: int, step: float, period: float) -> Float[Tensor, "N k"]:
    """Draw band-limited paths of variance 1, (N, k): white noise filtered by a Gaussian of width ``period / 4`` s.

    Args:
        step: time between samples in s.
        period: shortest period with notable power, in s.
    """
    width = max(period / 4.0 / step, 1e-3)
    reach = max(math.ceil(4.0 * width), 1)
    window = torch.exp(-0.5 * (torch.arange(-reach, reach + 1, dtype=torch.float64) / width).square())
    window = window / window.square().sum().sqrt()
    white = normal(g, columns, samples + 2 * reach)
    size = samples + 4 * reach
    path = torch.fft.irfft(torch.fft.rfft(white, size) * torch.fft.rfft(window, size), size)
    return path[:, 2 * reach : 2 * reach + samples].mT.contiguous()
