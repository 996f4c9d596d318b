"""Simulated turning sensors whose offset changes, or not; run as a script, it counts false alarms and changes found.

python -m tests.calibration.changing_offset [RECORDINGS]
"""

import sys

import numpy as np
import torch

from mkc_torch.calibration import NotIdentifiableError, calibrate
from mkc_torch.recording.recording import Recording

RATE = 50.0
FIELD = np.array([20.0, 5.0, -43.0])
NOISES = ("white", "autocorrelated", "heavy-tailed", "passing magnet", "uneven field")
NONE = (0.0, "step", 0.5)


def _rotations(count, draw):
    """Rotation matrices of a sensor that is turned by hand, (N, 3, 3)."""
    rate = np.zeros((count, 3))
    memory = np.exp(-1.0 / RATE)
    noise = 1.5 * np.sqrt(1.0 - memory**2) * draw.normal(size=(count, 3))
    found, turned = np.empty((count, 3, 3)), np.eye(3)
    for row in range(count):
        rate[row] = memory * rate[row - 1] + noise[row]
        x, y, z = rate[row] / RATE
        skew = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        turned = turned @ np.linalg.solve(np.eye(3) - 0.5 * skew, np.eye(3) + 0.5 * skew)
        found[row] = turned
    return found


def _first_order(count, draw, memory, size):
    values = size * np.sqrt(1.0 - memory**2) * draw.normal(size=(count, 3))
    for row in range(1, count):
        values[row] += memory * values[row - 1]
    return values


def _direction(draw):
    vector = draw.normal(size=3)
    return vector / np.linalg.norm(vector)


def changing(seed, count=4500, noise="white", scale=0.3, change=NONE):
    """A recording in µT; ``change`` is the size in µT, the kind, and the share before a step."""
    draw = np.random.default_rng(seed)
    turned, field = _rotations(count, draw), FIELD
    if noise == "uneven field":  # by about 1 µT over the 0.1 m that a hand moves
        gradient = draw.normal(size=(3, 3))
        field = FIELD + 0.5 * _first_order(count, draw, 0.995, 1.0) @ (gradient + gradient.T)
    points = np.einsum("nij,nj->ni", turned.transpose(0, 2, 1), np.broadcast_to(field, (count, 3)))
    distortion = 0.05 * draw.normal(size=(3, 3))
    points = points @ (np.eye(3) + 0.5 * (distortion + distortion.T)) + 20.0 * draw.normal(size=3)
    if noise == "heavy-tailed":
        points += scale * draw.standard_t(3, size=(count, 3))
    elif noise == "autocorrelated":
        points += _first_order(count, draw, 0.9, scale)
    else:
        points += scale * draw.normal(size=(count, 3))
    if noise == "passing magnet":
        begin = draw.integers(0, count - 250)
        points[begin : begin + 250] += 15.0 * draw.normal(size=3)
    size, kind, share = change
    place = np.arange(count)[:, None] / count
    one, other = size * _direction(draw), size * _direction(draw)
    angle = 2.0 * np.pi * place
    courses = {"step": (place >= share) * one, "drift": place * one}
    points += courses.get(kind, np.cos(angle) * one + np.sin(angle) * other)
    axes = {f"mag_{axis}": torch.tensor(points[:, k]) for k, axis in enumerate("xyz")}
    return Recording({"time": torch.arange(count) / RATE, **axes}, name="turned")


def _outcome(recording):
    try:
        found = calibrate(recording).offset_change
    except NotIdentifiableError:
        return "refused"
    return "none" if found is None else found.kind


def main(recordings):
    for noise in NOISES:
        lengths = [(1500, 4500, 9000)[seed % 3] for seed in range(recordings)]
        found = [calibrate(changing(seed, lengths[seed], noise)).offset_change for seed in range(recordings)]
        print(f"{noise}: {sum(change is not None for change in found)} false alarms of {recordings}", flush=True)
    for change in ((9.4, "step", 0.5), (3.0, "step", 0.5), (1.5, "step", 1 / 3), (2.0, "drift", 0.0), (1.0, "turn", 0)):
        outcomes = [_outcome(changing(seed, change=change)) for seed in range(max(1, recordings // 10))]
        counts = ", ".join(f"{outcomes.count(kind)} {kind}" for kind in sorted(set(outcomes)))
        print(f"{change[0]} µT {change[1]}: {counts}", flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 60)
