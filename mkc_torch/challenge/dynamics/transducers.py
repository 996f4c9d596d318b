"""Actuators and sensors that are not quite what is sent to them, and what they measure."""

from __future__ import annotations

import numpy as np

from mkc_torch.challenge.dynamics.plant import Array, SignalChange


def only(channel: int, change: SignalChange) -> SignalChange:
    """The change of one channel of several."""

    def changed(values: Array, step: float, size: float) -> Array:
        out = values.copy()
        out[channel] = change(values[[channel]], step, size)[0]
        return out

    return changed


def transport(values: Array, step: float, size: float) -> Array:
    """A pipe or a bus: everything ``size`` s later; before, what there was at the beginning."""
    place = np.maximum(np.arange(values.shape[1]) - size / step, 0.0)
    at = np.minimum(place.astype(int), values.shape[1] - 2)
    share = (place - at)[None, :, None]
    return values[:, at] * (1.0 - share) + values[:, at + 1] * share


def lags(count: int) -> SignalChange:
    """So many lags of first order in series, whose delays sum to ``size`` s."""

    def change(values: Array, step: float, size: float) -> Array:
        for _ in range(count):
            values = lagged(values, step, size / count)
        return values

    return change


def housing(values: Array, step: float, size: float) -> Array:
    """A sensor in a housing: a lag of ``size`` s, and one of a third of it."""
    return lagged(lagged(values, step, size), step, size / 3.0)


def lagged(values: Array, step: float, constant: float) -> Array:
    """``constant ẏ = x - y`` from rest at the first value, exact for an x that is linear between moments.

    Example:
        >>> lagged(np.array([[[0.0], [1.0], [2.0]]]), 1.0, 0.0)[0, :, 0].tolist()
        [0.0, 1.0, 2.0]
    """
    if constant <= 1e-9 * step:
        return values
    return lagged_each(values, step, np.array([constant]))[..., 0]


def lagged_each(values: Array, step: float, constants: Array) -> Array:
    """The same with each of several constants (q,), all of them longer than 0.

    Returns:
        (channels, moments, R, q).
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
    """What follows signals (k, moments, R) over a gap of twice ``half``, in its middle when a run begins.

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
    """A linkage of several worn joints (Prandtl and Ishlinskii): their mean half gap is ``size`` of the largest."""

    def change(values: Array, step: float, size: float) -> Array:  # noqa: ARG001
        return np.mean([play(values, share * size * largest) for share in (0.5, 1.0, 1.5)], axis=0)

    return change


def soft_limit(largest: float, sharpness: float) -> SignalChange:
    """An amplifier that gives way smoothly: its limit is ``largest / size``."""

    def change(values: Array, step: float, size: float) -> Array:  # noqa: ARG001
        ratio = np.abs(values) * size / largest
        return values / (1.0 + ratio**sharpness) ** (1.0 / sharpness)

    return change


def soft_gap(largest: float) -> SignalChange:
    """A valve with overlap: commands below ``size`` of the largest do little, and larger ones lose as much."""

    def change(values: Array, step: float, size: float) -> Array:  # noqa: ARG001
        width = max(size * largest, 1e-12)
        return values - width * np.tanh(values / width)

    return change


def follower(values: Array, step: float, size: float) -> Array:
    """An actuator that follows its command: a lag of ``size`` s, and its electronics with one of a twelfth."""
    return lagged(lagged(values, step, size), step, size / 12.0)


def squared(largest: float, power: float) -> SignalChange:
    """An actuator that acts by about the square of its command; ``size`` of it does, and it is right at the largest."""

    def change(values: Array, step: float, size: float) -> Array:  # noqa: ARG001
        ratio = values / largest
        return values + size * (largest * np.sign(ratio) * np.abs(ratio) ** power - values)

    return change


def worn_gear(values: Array, step: float, size: float) -> Array:  # noqa: ARG001
    """A gear whose teeth are worn unevenly: its mean half gap is ``size``."""
    return np.mean([play(values, share * size) for share in (0.7, 1.0, 1.3)], axis=0)


def wrong_zero(share: float, phase: float) -> SignalChange:
    """A zero that is off by ``size``, and by a share more or less about three times a turn of an angle in rad."""

    def change(values: Array, step: float, size: float) -> Array:  # noqa: ARG001
        return values + size * (1.0 + share * np.sin(3.0 * values + phase))

    return change


def sagging(level: float) -> SignalChange:
    """A joint held by a spring of a controller: its load pulls it aside at the angle where it then is, in rad.

    Args:
        level: angle at which the link is level; there it sags by ``size``.
    """

    def change(values: Array, step: float, size: float) -> Array:  # noqa: ARG001
        angle = values
        for _ in range(30):
            angle = values + size * np.cos(angle - level)
        return angle

    return change


def shaken(omega: float) -> SignalChange:
    """A sensor on a machine that shakes, by ``size``, at omega in rad/s."""

    def change(values: Array, step: float, size: float) -> Array:
        return values + size * np.sin(omega * np.arange(values.shape[1]) * step)[None, :, None]

    return change
