"""Diagnose recorded turns that disagree with the field: sign, degrees, axes, quaternion order, or lag."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from mkc_torch.calibration.aided.misfit import misfit_of_attitude, misfit_of_gyroscope, stretches
from mkc_torch.calibration.aided.rotation import from_quaternion, gaps, rotation_since

if TYPE_CHECKING:
    from jaxtyping import Float, Int

AXES = ("x", "y", "z")

HALVES = 0.5
"""Largest residual after a correction, as a share of the residual before."""

_PLAIN = 1.2
"""Largest residual of a simpler explanation that is preferred, in multiples of the smallest residual."""

_DEGREES = math.pi / 180.0
_OVER = 0.1
"""Interval in s over which the field's turn is compared with the recorded turn."""

LAG = 2.0
"""Largest lag that is tried, in s."""

_LAG_STEP = 0.01
"""Smallest step between lags, in s."""

_REWEIGHTED = 6
"""Iterations of the reweighted least squares fit."""

_MOST = 6000
"""Most samples of a comparison."""


class Fault(NamedTuple):
    """A fault as a sentence, and the size of the residual after its correction, in the field's unit."""

    sentence: str
    left: float


class _Trial(NamedTuple):
    sentence: str
    left: Callable[[], float]


def gyroscope_fault(
    field: Float[Tensor, "N 3"],
    time: Float[Tensor, " N"],
    rate: Float[Tensor, "N 3"],
    window: Int[Tensor, " N"],
    first: Int[Tensor, " N"],
    left: float,
) -> Fault | None:
    """Find the fault of a gyroscope's rates; None if no correction halves the residual.

    Args:
        field: calibrated field, corrected for the sensor's offset and gains.
        time: in s, ascending.
        rate: rates in rad/s, as recorded.
        window: index of each sample's window, in which the rotated field is constant.
        first: index of the first sample of that window.
        left: size of the residual with the recorded rates.

    Example:
        >>> time = torch.arange(0.0, 20.0, 0.02).double()
        >>> rate = torch.stack([time.sin(), (0.7 * time).cos(), 0.0 * time], -1)
        >>> window = (time / 2.0).long()
        >>> first = 100 * window
        >>> turned = rotation_since(time, rate, first)
        >>> field = turned.mT @ torch.tensor([20.0, 0.0, -40.0]).double()
        >>> gyroscope_fault(field, time, -rate, window, first, 10.0).sentence
        'The rates seem to have the other sign.'
    """
    stretch = stretches(time)

    def left_with(rates: Tensor) -> float:
        return misfit_of_gyroscope(field, rotation_since(time, rates, first), window, stretch)

    def trials() -> Iterator[_Trial]:
        yield _Trial("The rates seem to have the other sign.", partial(left_with, -rate))
        yield _Trial("The rates seem to be in degrees per second, not in rad/s.", partial(left_with, _DEGREES * rate))
        yield _Trial(
            "The rates seem to be in degrees per second, not in rad/s, and of the other sign.",
            partial(left_with, -_DEGREES * rate),
        )
        seen = _axes(field, time, rate)
        for scale, unit in ((1.0, ""), (_DEGREES, ", and in degrees per second")):
            for axes, sentence in _turns_near(seen):
                yield _Trial(
                    f"The gyroscope's axes seem to differ from the magnetometer's: {sentence}{unit}.",
                    partial(left_with, scale * rate @ axes.mT),
                )
        lag = _lag(field, time, rate)
        yield _Trial(_late("The rates", lag), partial(left_with, _shifted(time, rate, lag)))

    return _best(trials(), left)


def attitude_fault(
    field: Float[Tensor, "N 3"], time: Float[Tensor, " N"], quaternion: Float[Tensor, "N 4"], left: float
) -> Fault | None:
    """Find the fault of a recorded attitude; None if no correction halves the residual.

    The attitude may have other axes than the magnetometer: the response matrix includes that rotation.

    Args:
        field: calibrated field, corrected for the sensor's offset and gains.
        time: in s, ascending.
        quaternion: w, x, y, z, as recorded.
        left: size of the residual with the recorded attitude.
    """
    stretch = stretches(time)
    to_world = from_quaternion(quaternion)

    def left_with(attitude: Tensor) -> float:
        return misfit_of_attitude(field, attitude, stretch)

    def trials() -> Iterator[_Trial]:
        yield _Trial(
            "The quaternions seem to be inverted: give the conjugate, with q_x, q_y and q_z of the other sign.",
            partial(left_with, to_world.mT),
        )
        yield _Trial(
            "The quaternions seem to be in the order x, y, z, w: name the last column q_w.",
            partial(left_with, from_quaternion(quaternion.roll(1, -1))),
        )
        lag = _lag(field, time, _rates(time, to_world))
        yield _Trial(
            _late("The attitude", lag), partial(left_with, from_quaternion(_shifted_quaternion(time, quaternion, lag)))
        )

    return _best(trials(), left)


def _best(trials: Iterator[_Trial], left: float) -> Fault | None:
    """The simplest fault whose residual is about as small as the smallest; None if none halves the residual."""
    tried = [Fault(trial.sentence, trial.left()) for trial in trials]
    least = min(trial.left for trial in tried)
    if not least < HALVES * left:
        return None
    return next(trial for trial in tried if trial.left <= _PLAIN * least)


def _pairs(
    field: Tensor, time: Tensor, rate: Tensor, shift: float = 0.0
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Mean field, change of the field, and recorded turn over intervals of 0.1 s, (n, 3) each."""
    step = max(1, round(_OVER / float(time.diff().median())))
    broken = torch.cat([gaps(time).cumsum(0)[:1] * 0, gaps(time).cumsum(0)])
    number = torch.arange(len(time) - step)
    number = number[broken[number] == broken[number + step]]
    number = number[:: max(1, len(number) // _MOST)]
    begin, end = field[number], field[number + step]
    turn = _shifted(time, _turned(time, rate), shift)
    return 0.5 * (begin + end), end - begin, turn[number + step] - turn[number]


def _turned(time: Tensor, rate: Tensor) -> Tensor:
    """Integrate the rates, (N, 3) in rad."""
    known = rate.nan_to_num(0.0)
    step = 0.5 * (known[1:] + known[:-1]) * time.diff().unsqueeze(-1)
    return torch.cat([torch.zeros_like(rate[:1]), step.cumsum(0)])


def _axes(field: Tensor, time: Tensor, rate: Tensor) -> Float[Tensor, "3 3"]:
    """The matrix A that maps recorded rates to those of the field, by robust least squares: dB = B x (A turn)."""
    middle, change, turn = _pairs(field, time, rate)
    zero = torch.zeros_like(middle[:, 0])
    x, y, z = middle.unbind(-1)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))
    regressors = torch.einsum("nij,nk->nijk", cross, turn).flatten(2)
    weight = turn.new_ones(len(turn), 1, 1)
    entries = turn.new_zeros(9)
    for _ in range(_REWEIGHTED):
        gram = (weight * regressors).flatten(0, 1).mT @ regressors.flatten(0, 1)
        moment = (weight * regressors).flatten(0, 1).mT @ change.flatten()
        ridge = 1e-9 * gram.diagonal().mean().clamp(min=1e-300) * torch.eye(9, dtype=gram.dtype)
        entries = torch.linalg.solve(gram + ridge, moment)
        left = torch.linalg.vector_norm(change - regressors @ entries, dim=-1)
        scale = 2.0 * left.median().clamp(min=1e-12)
        weight = torch.exp(-0.5 * (left / scale).square())[:, None, None]
    return entries.unflatten(0, (3, 3))


def _turns_near(seen: Float[Tensor, "3 3"]) -> Iterator[tuple[Float[Tensor, "3 3"], str]]:
    """Yield the nearest exchange of axes and signs to a matrix, and the nearest rotation, each with a description."""
    best, size = None, -math.inf
    for order in itertools.permutations(range(3)):
        entries = seen[torch.arange(3), list(order)]
        if float(entries.abs().sum()) > size:
            best, size = (order, [1.0 if float(v) >= 0.0 else -1.0 for v in entries]), float(entries.abs().sum())
    assert best is not None
    order, signs = best
    exchange = torch.zeros_like(seen)
    for k, (column, sign) in enumerate(zip(order, signs, strict=True)):
        exchange[k, column] = sign
    description = ", ".join(
        f"its {AXES[k]} is {'minus ' if sign < 0 else ''}{AXES[column]} as recorded"
        for k, (column, sign) in enumerate(zip(order, signs, strict=True))
    )
    yield exchange, description
    left, _, right = torch.linalg.svd(seen)
    turn = (
        left @ torch.diag(torch.stack([seen.new_ones(()), seen.new_ones(()), torch.linalg.det(left @ right)])) @ right
    )
    angle = math.degrees(math.acos(min(1.0, max(-1.0, 0.5 * (float(turn.diagonal().sum()) - 1.0)))))
    axis = torch.stack([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    x, y, z = (axis / torch.linalg.vector_norm(axis).clamp(min=1e-12)).tolist()
    yield turn, f"turned by {angle:.0f}° about ({x:+.2f}, {y:+.2f}, {z:+.2f})"


def _lag(field: Tensor, time: Tensor, rate: Tensor) -> float:
    """The lag in s of the rates that agrees best with the field; positive if the rates are late."""
    step = max(_LAG_STEP, float(time.diff().median()))
    count = int(LAG / step)

    def left(shift: float) -> float:
        middle, change, turn = _pairs(field, time, rate, shift)
        return float(torch.linalg.vector_norm(change - torch.linalg.cross(middle, turn), dim=-1).mean())

    best = min(range(-count, count + 1), key=lambda k: left(k * step))
    fine = min(range(-5, 6), key=lambda k: left((best + 0.2 * k) * step))
    return (best + 0.2 * fine) * step


def _late(what: str, lag: float) -> str:
    return f"{what} seem{'' if what.endswith('s') else 's'} to be {'late' if lag > 0 else 'early'} by {abs(lag):.2g} s."


def _shifted(time: Tensor, values: Tensor, lag: float) -> Tensor:
    """Interpolate values linearly at times later by ``lag``; constant beyond the first and last sample."""
    if lag == 0.0:
        return values
    at = (time + lag).clamp(float(time[0]), float(time[-1]))
    after = torch.searchsorted(time, at).clamp(1, len(time) - 1)
    share = (at - time[after - 1]) / (time[after] - time[after - 1]).clamp(min=1e-12)
    return torch.lerp(values[after - 1], values[after], share.clamp(0.0, 1.0).unsqueeze(-1))


def _shifted_quaternion(time: Tensor, quaternion: Tensor, lag: float) -> Tensor:
    """Interpolate quaternions at times later by ``lag``, after making their signs continuous."""
    unit = quaternion / torch.linalg.vector_norm(quaternion, dim=-1, keepdim=True)
    opposite = (unit[1:] * unit[:-1]).sum(-1) < 0.0
    sign = torch.cat([opposite[:1] * 0, opposite.cumsum(0) % 2]).to(unit)
    return _shifted(time, unit * (1.0 - 2.0 * sign).unsqueeze(-1), lag)


def _rates(time: Tensor, to_world: Tensor) -> Tensor:
    """Body rates of an attitude in rad/s, by finite differences, (N, 3)."""
    step = to_world[:-1].mT @ to_world[1:]
    axis = 0.5 * torch.stack(
        [step[:, 2, 1] - step[:, 1, 2], step[:, 0, 2] - step[:, 2, 0], step[:, 1, 0] - step[:, 0, 1]], -1
    )
    sine = torch.linalg.vector_norm(axis, dim=-1, keepdim=True)
    angle = torch.atan2(sine[:, 0], 0.5 * (step.diagonal(dim1=-2, dim2=-1).sum(-1) - 1.0)).unsqueeze(-1)
    between = axis * torch.where(sine > 1e-9, angle / sine.clamp(min=1e-9), 1.0) / time.diff().unsqueeze(-1)
    middle = 0.5 * (between[1:] + between[:-1])
    return torch.cat([between[:1], middle, between[-1:]])
