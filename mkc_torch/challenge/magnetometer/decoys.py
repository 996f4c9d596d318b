"""Columns without effect: trends, random walks, and inexact copies of the true driver."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Generator, Tensor

from mkc_torch.challenge.draws import choose, happens, log_uniform, normal, smooth, uniform, whole
from mkc_torch.challenge.magnetometer.drivers import lagged

if TYPE_CHECKING:
    from jaxtyping import Float

COPY_SHARE = 0.5
"""Share of the recordings with a recordable driver in which one column or two resemble it."""

COPIES = ("correlated 0.5", "correlated 0.9", "correlated 0.99", "noisy", "lagged")
COPY_SHARES = (0.3, 0.3, 0.1, 0.15, 0.15)


@dataclass(frozen=True)
class Decoy:
    """The kind of a column, and its unit."""

    kind: str
    scale: float
    shift: float


def draw_decoys(g: Generator, *, copies: bool) -> list[Decoy]:
    """Draw one to five decoys; with ``copies`` some may resemble the driver."""
    kinds = [choose(g, ("trend", "walk", "wave")) for _ in range(whole(g, 1, 3))]
    if copies and happens(g, COPY_SHARE):
        kinds += [choose(g, COPIES, COPY_SHARES) for _ in range(whole(g, 1, 2))]
    order = torch.randperm(len(kinds), generator=g).tolist()
    return [Decoy(kinds[k], log_uniform(g, 0.1, 100.0), 10.0 * float(normal(g, 1))) for k in order]


def decoy_column(
    g: Generator, decoy: Decoy, time: Float[Tensor, " N"], driver: Float[Tensor, " N"] | None
) -> Float[Tensor, " N"]:
    """Return the column in its unit."""
    if decoy.kind in COPIES and driver is not None:
        values = copy(g, decoy.kind, time, driver)
    else:
        values = plain(g, decoy.kind, time)
    return decoy.scale * values + decoy.shift


def plain(g: Generator, kind: str, time: Float[Tensor, " N"]) -> Float[Tensor, " N"]:
    """Draw an unrelated column of size about 1."""
    count, step = len(time), float(time[1] - time[0])
    if kind == "trend":
        way = choose(g, (-1.0, 1.0))
        return way * torch.linspace(0.0, 3.0, count, dtype=torch.float64) + uniform(g, 0.02, 0.5) * normal(g, count)
    if kind == "walk":
        return normal(g, count).cumsum(0) / math.sqrt(count) * 3.0
    return smooth(g, count, 1, step, log_uniform(g, 0.5, 30.0))[:, 0] + 0.05 * normal(g, count)


def copy(g: Generator, kind: str, time: Float[Tensor, " N"], driver: Float[Tensor, " N"]) -> Float[Tensor, " N"]:
    """Draw a column that resembles the driver: correlated, with white noise, or delayed."""
    count, step = len(time), float(time[1] - time[0])
    x = (driver - driver.mean()) / driver.std().clamp(min=1e-12)
    if kind == "noisy":
        return x + uniform(g, 0.1, 1.0) * normal(g, count)
    if kind == "lagged":
        return lagged(x, step, log_uniform(g, 0.5, 10.0)) + 0.01 * normal(g, count)
    wanted = float(kind.split()[1])
    other = smooth(g, count, 1, step, uniform(g, 5.0, 25.0))[:, 0]
    other = other - other.mean() - (other * x).mean() * x
    return wanted * x + math.sqrt(1.0 - wanted**2) * other / other.std()
