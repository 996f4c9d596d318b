"""Format numbers for export files, and make matrices symmetric for autopilots."""

from __future__ import annotations

import math

import numpy as np

from mkc_torch.calibration.exports.base import ExportError

SMALLEST = float(np.finfo(np.float32).tiny)
"""Smallest normal number of 32 bits."""

_SYMMETRIC = 1e-9
"""Largest asymmetry of a symmetric matrix, relative to its largest entry."""

_REPORTED_ANGLE = 0.01
"""Smallest rotation in ° that a warning reports."""


def single(value: float) -> str:
    """Format a number with the shortest digits that are unique among 32-bit numbers, without exponent; 0 if too small.

    Raises:
        ExportError: the number is beyond the range of 32 bits.

    Example:
        >>> single(0.1), single(-2.0), single(1.25e-7)
        ('0.1', '-2.0', '0.000000125')
    """
    size = abs(value)
    if size > float(np.finfo(np.float32).max):
        raise not_held(size)
    return np.format_float_positional(np.float32(value if size >= SMALLEST else 0.0), unique=True, trim="0")


def not_held(size: float) -> ExportError:
    """The error about a number beyond the range of 32 bits."""
    return ExportError(
        f"the calibration has a number of size {size:.1e}, which is beyond the range of 32 bits; calibrate again with "
        "the columns in µT, gauss or mG."
    )


def one_line(text: str) -> str:
    """Format a text for a comment: on a single line, and without the marks of C comments.

    Example:
        >>> one_line("a\\n*/ b")
        'a * / b'
    """
    return " ".join(text.split()).replace("*/", "* /").replace("/*", "/ *")


def symmetric(matrix: np.ndarray, kind: str) -> tuple[np.ndarray, str | None]:
    """The symmetric factor of a matrix, which gives the same lengths, and a warning about the omitted rotation.

    A matrix is the product of a rotation and a symmetric matrix (polar decomposition). Autopilots use the symmetric
    matrix; the rotation is the sensor's mounting.

    Args:
        matrix: (3, 3).
        kind: name of the export, for the message.

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
            f"the calibration matrix mirrors the axes, which {kind} does not support; check the signs of the "
            "magnetometer's columns and calibrate again."
        )
    warning = None
    angle = math.degrees(math.acos(min(max(0.5 * (float(np.trace(turn)) - 1.0), -1.0), 1.0)))
    if angle > _REPORTED_ANGLE:
        axis = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
        axis = axis / max(float(np.linalg.norm(axis)), 1e-300)
        about = ", ".join(f"{value:+.2f}" for value in axis)
        warning = (
            f"The calibration matrix also turns the field by {angle:.2f}° about ({about}), which is left out: {kind} "
            "uses a symmetric matrix and a separate mounting of the sensor. Length and offset are unchanged."
        )
    return (right.T * sizes) @ right, warning


def yaml_double(value: float) -> str:
    """Format a number so that YAML 1.1 reads it as a number: with a decimal point before an exponent.

    Example:
        >>> yaml_double(1.25e-05), yaml_double(2e-14)
        ('1.25e-05', '2.0e-14')
    """
    digits, power, exponent = repr(float(f"{value:.12g}")).partition("e")
    return f"{digits if '.' in digits else digits + '.0'}{power}{exponent}"
