"""Numbers as files hold them, and the matrices that autopilots take."""

from __future__ import annotations

import math

import numpy as np

from mkc_torch.calibration.exports.base import ExportError

__all__ = ["SMALLEST", "not_held", "one_line", "single", "symmetric"]

SMALLEST = float(np.finfo(np.float32).tiny)
"""Of the numbers of 32 bits that have all their digits."""

_SYMMETRIC = 1e-9
_TOLD = 0.01  # degrees


def single(value: float) -> str:
    """A number with the digits that tell it from all others of 32 bits, and no power of ten; nothing if too small.

    Raises:
        ExportError: 32 bits hold no number so large.

    Example:
        >>> single(0.1), single(-2.0), single(1.25e-7)
        ('0.1', '-2.0', '0.000000125')
    """
    size = abs(value)
    if size > float(np.finfo(np.float32).max):
        raise not_held(size)
    return np.format_float_positional(np.float32(value if size >= SMALLEST else 0.0), unique=True, trim="0")


def not_held(size: float) -> ExportError:
    """The error for a number that 32 bits do not hold."""
    return ExportError(
        f"the calibration has a number of the size {size:.1e}, which 32 bits do not hold; calibrate again with the "
        "columns in µT, gauss or mG."
    )


def one_line(text: str) -> str:
    """A text for a comment: on one line, and without what ends a comment in C.

    Example:
        >>> one_line("a\\n*/ b")
        'a * / b'
    """
    return " ".join(text.split()).replace("*/", "* /").replace("/*", "/ *")


def symmetric(matrix: np.ndarray, kind: str) -> tuple[np.ndarray, str | None]:
    """The symmetric matrix that makes the same lengths, and a sentence about the turn that it leaves out.

    A matrix is the product of a turn and of a symmetric one (its polar decomposition). Autopilots take the symmetric
    one, and the turn is the sensor's mounting.

    Args:
        matrix: (3, 3).
        kind: of file, for the message.

    Raises:
        ExportError: the matrix mirrors the axes.

    Example:
        >>> quarter = np.array([[0.0, -2.0, 0.0], [2.0, 0.0, 0.0], [0.0, 0.0, 2.0]])
        >>> symmetric(quarter, "px4")[0].round(6) + 0.0
        array([[2., 0., 0.],
               [0., 2., 0.],
               [0., 0., 2.]])
    """
    if np.abs(matrix - matrix.T).max() <= _SYMMETRIC * np.abs(matrix).max():
        return 0.5 * (matrix + matrix.T), None
    left, sizes, right = np.linalg.svd(matrix)
    turn = left @ right
    if np.linalg.det(turn) < 0:
        raise ExportError(
            f"the calibration matrix mirrors the axes, and {kind} takes none that does; check the signs of the "
            "magnetometer's columns and calibrate again."
        )
    told = None
    angle = math.degrees(math.acos(min(max(0.5 * (float(np.trace(turn)) - 1.0), -1.0), 1.0)))
    if angle > _TOLD:
        axis = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
        axis = axis / max(float(np.linalg.norm(axis)), 1e-300)
        about = ", ".join(f"{value:+.2f}" for value in axis)
        told = (
            f"The calibration matrix also turns the field by {angle:.2f}° about ({about}), which is left out: {kind} "
            "takes a symmetric matrix, and the sensor's mounting apart from it. Length and offset are as they were."
        )
    return (right.T * sizes) @ right, told
