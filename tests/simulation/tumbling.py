"""Recordings of a sensor that turns through all directions, by SciPy's rotations, with known truth."""

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from mkc_torch.recording.recording import Recording

FIELD = np.array([4.0, 20.0, -42.0])  # µT: east, north, up
OFFSET = np.array([12.0, -7.5, 21.0])  # µT
RESPONSE = np.array([[1.06, 0.03, -0.02], [0.03, 0.95, 0.015], [-0.02, 0.015, 1.01]])
RATE = 50.0  # Hz


def turns(time, size=(1.0, 1.0, 1.0)):
    """Rotations from the sensor frame to the world frame; ``size`` scales the yaw, pitch and roll angles."""
    yaw = 2.0 * np.pi * time / 2.9 + 0.4 * np.sin(1.1 * time)
    pitch = 2.0 * np.pi * time / 7.0 + 0.3 * np.sin(0.7 * time + 1.0)
    roll = 2.0 * np.pi * time / 5.0 + 0.3 * np.sin(0.43 * time)
    return Rotation.from_euler("ZYX", np.stack([yaw, pitch, roll], -1) * np.asarray(size))


def body_rate(time, size=(1.0, 1.0, 1.0), step=1e-5):
    """Angular rate in the sensor frame in rad/s, by central differences of the rotation."""
    before, after = turns(time - step, size), turns(time + step, size)
    return (before.inv() * after).as_rotvec() / (2.0 * step)


def tumbling(
    N=1000,
    *,
    noise=0.0,
    sensor=None,
    field=FIELD,
    size=(1.0, 1.0, 1.0),
    gyro=False,
    attitude=False,
    rate=RATE,
    seed=0,
    moments=None,
    **columns,
):
    """Return a recording; ``sensor`` (N, 3) in µT is added to the measurement, ``columns`` to the table.

    ``moments`` (N,) in s are the times of the motion, if they differ from the times of the samples.
    """
    time = np.arange(N) / rate
    rotation = turns(time if moments is None else moments, size)
    ambient = rotation.inv().apply(field)
    measured = ambient @ RESPONSE.T + OFFSET
    measured = measured + noise * np.random.default_rng(seed).standard_normal((N, 3))
    if sensor is not None:
        measured = measured + np.asarray(sensor)
    table = {"time": time} | {f"mag_{axis}": measured[:, k] for k, axis in enumerate("xyz")}
    if gyro:
        table |= {f"gyro_{axis}": column for axis, column in zip("xyz", body_rate(time, size).T, strict=True)}
    if attitude:
        x, y, z, w = rotation.as_quat().T
        table |= {"q_w": w, "q_x": x, "q_y": y, "q_z": z}
    table |= columns
    return Recording({name: torch.as_tensor(np.array(values)) for name, values in table.items()}, name="tumbling")


def resting(N, first, last, rate=RATE):
    """Moments of a motion that rests between two samples."""
    steps = np.ones(N)
    steps[first:last] = 0.0
    return np.cumsum(steps) / rate


def changed(recording, **columns):
    """Return the recording with columns replaced, added, or (None) removed."""
    table = {name: values for name, values in recording.columns.items() if columns.get(name, 0) is not None}
    added = {name: torch.as_tensor(values) for name, values in columns.items() if values is not None}
    return Recording(table | added, name=recording.name)


def true_matrix(strength):
    """Return the calibration matrix for an ambient field of this strength."""
    return np.linalg.inv(RESPONSE) * (strength / np.linalg.norm(FIELD))


def full_truth(strength, *tilt):
    """Parameters of the view with a full response matrix; the tilt of the field is relative to the view's start."""
    return torch.tensor([*OFFSET, *np.linalg.inv(true_matrix(strength)).ravel(), *tilt])


def symmetric_truth(strength, further=0):
    """Parameters of the views with a symmetric matrix (the response here is symmetric), and zeros after them."""
    matrix = true_matrix(strength)
    upper = [matrix[i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]
    return torch.tensor([*OFFSET, *upper, *[0.0] * further])
