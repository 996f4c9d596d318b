"""Imperfect actuators and sensors."""

from __future__ import annotations

import numpy as np

from examples.blind_proof.equations.plant import Array, SignalChange


def only(channel: int, change: SignalChange) -> SignalChange:
    """Apply a change to one of several channels."""

    def changed(values: Array, step: float, size: float) -> Array:
        out = values.copy()
        out[channel] = change(values[[channel]], step, size)[0]
        return out

    return changed


def transport(values: Array, step: float, size: float) -> Array:
    """A delay of ``size`` s; the first value is held before."""
    place = np.maximum(np.arange(values.shape[1]) - size / step, 0.0)
    at = np.minimum(place.astype(int), values.shape[1] - 2)
    share = (place - at)[None, :, None]
    return values[:, at] * (1.0 - share) + values[:, at + 1] * share


def lags(count: int) -> SignalChange:
    """First-order lags in series, whose time constants sum to ``size`` s."""

    def change(values: Array, step: float, size: float) -> Array:
        for _ in range(count):
            values = lagged(values, step, size / count)
        return values

    return change


def housing(values: Array, step: float, size: float) -> Array:
    """A sensor in a housing: a lag of ``size`` s, and one of a third of it."""
    return lagged(lagged(values, step, size), step, size / 3.0)


def lagged(values: Array, step: float, constant: float) -> Array:
    """Solve ``constant ẏ = x - y`` from the first value, exactly for an x that is linear between times.

    Example:
        >>> lagged(np.array([[[0.0], [1.0], [2.0]]]), 1.0, 0.0)[0, :, 0].tolist()
        [0.0, 1.0, 2.0]
    """
    if constant <= 1e-9 * step:
        return values
    return lagged_each(values, step, np.array([constant]))[..., 0]


def lagged_each(values: Array, step: float, constants: Array) -> Array:
    """Solve ``constant ẏ = x - y`` for several positive constants (q,).

    Returns:
        (channels, times, R, q).
    """
    ratio = step / constants
    keep = np.exp(-ratio)
    late = (1.0 - keep) / ratio
    wide = values[..., None]
    drive = (late - keep) * wide[:, :-1] + (1.0 - late) * wide[:, 1:]
    out = np.empty((*values.shape, len(constants)))
    out[:, 0] = y = np.broadcast_to(wide[:, 0], out[:, 0].shape)
    for k in range(1, values.shape[1]):
        out[:, k] = y = keep * y + drive[:, k - 1]
    return out


def play(values: Array, half: float) -> Array:
    """Return the output of a backlash of ``2 half`` on signals (k, times, R), which starts in the middle of the gap.

    Example:
        >>> play(np.array([[[0.0], [3.0], [2.5], [-1.0]]]), 1.0)[0, :, 0].tolist()
        [0.0, 2.0, 2.0, 0.0]
    """
    out = np.empty_like(values)
    out[:, 0] = y = values[:, 0]
    for k in range(1, values.shape[1]):
        out[:, k] = y = np.clip(y, values[:, k] - half, values[:, k] + half)
    return out


def worn_linkage(largest: float) -> SignalChange:
    """A linkage of worn joints (Prandtl-Ishlinskii); the mean half gap is ``size`` times the largest signal."""

    def change(values: Array, step: float, size: float) -> Array:
        return np.mean([play(values, share * size * largest) for share in (0.5, 1.0, 1.5)], axis=0)

    return change


def soft_limit(largest: float, sharpness: float) -> SignalChange:
    """An amplifier that saturates smoothly at ``largest / size``."""

    def change(values: Array, step: float, size: float) -> Array:
        ratio = np.abs(values) * size / largest
        return values / (1.0 + ratio**sharpness) ** (1.0 / sharpness)

    return change


def soft_gap(largest: float) -> SignalChange:
    """A valve with overlap: commands below ``size`` of the largest have little effect; larger are reduced as much."""

    def change(values: Array, step: float, size: float) -> Array:
        width = max(size * largest, 1e-12)
        return values - width * np.tanh(values / width)

    return change


def follower(values: Array, step: float, size: float) -> Array:
    """An actuator with a lag of ``size`` s, and its electronics with a lag of a twelfth of it."""
    return lagged(lagged(values, step, size), step, size / 12.0)


def squared(largest: float, power: float) -> SignalChange:
    """An actuator of which a share ``size`` follows about the square of its command; exact at the largest command."""

    def change(values: Array, step: float, size: float) -> Array:
        ratio = values / largest
        return values + size * (largest * np.sign(ratio) * np.abs(ratio) ** power - values)

    return change


def worn_gear(values: Array, step: float, size: float) -> Array:
    """A gear with unevenly worn teeth; the mean half gap is ``size``."""
    return np.mean([play(values, share * size) for share in (0.7, 1.0, 1.3)], axis=0)


def wrong_zero(share: float, phase: float) -> SignalChange:
    """A zero offset of ``size`` that varies by a share, three times a turn of an angle in rad."""

    def change(values: Array, step: float, size: float) -> Array:
        return values + size * (1.0 + share * np.sin(3.0 * values + phase))

    return change


def sagging(level: float) -> SignalChange:
    """A joint held by a spring-like controller: its load deflects it, depending on its angle in rad.

    Args:
        level: angle at which the link is horizontal; there it deflects by ``size``.
    """

    def change(values: Array, step: float, size: float) -> Array:
        angle = values
        for _ in range(30):
            angle = values + size * np.cos(angle - level)
        return angle

    return change


def shaken(omega: float) -> SignalChange:
    """A sensor on a vibrating machine, with amplitude ``size`` and frequency omega in rad/s."""

    def change(values: Array, step: float, size: float) -> Array:
        return values + size * np.sin(omega * np.arange(values.shape[1]) * step)[None, :, None]

    return change
