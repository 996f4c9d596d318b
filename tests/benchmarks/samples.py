"""CPU seconds of `mkc diagnose` over the samples of a recording, as a picture.

A rotor with one state is driven by a recorded torque; the simulation leaves out its quadratic drag. Each point is one
command with its start and its reports; `python -m tests.benchmarks.diagnosis --samples samples.png` draws it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch

from mkc_torch.recording.recording import write_table

__all__ = ["SAMPLES", "draw", "measure", "slope"]

SAMPLES = (1_000, 3_000, 10_000, 30_000, 100_000)

STEP = 0.02
"""Seconds from sample to sample."""

NOISE = 0.01
"""Standard deviation of the sensor's white noise in rad/s; the speed reaches 1.5 rad/s."""

ROTOR = """
from mkc_torch.simulation import Dynamics


class Rotor(Dynamics):
    states = ("speed",)
    inputs = ("torque",)
    parameters = {"damping": 0.5}

    def derivative(self, time, x, u, p):
        return {"speed": u.torque - p.damping * x.speed}

    def output(self, time, x, u, p):
        return {"speed": x.speed}
"""


def rotor(path: Path, samples: int) -> Path:
    """Write the recording: torque and speed with quadratic drag, integrated by Heun's method in four substeps."""
    time = STEP * torch.arange(samples, dtype=torch.float64)
    torque = torch.sin(1.3 * time) + torch.sin(0.31 * time) + 0.5 * torch.sign(torch.sin(0.17 * time))
    values, h, speed = torque.tolist(), STEP / 4.0, 0.0
    speeds = []
    for here, following in zip(values, [*values[1:], values[-1]], strict=True):
        speeds.append(speed)
        for part in range(4):
            first, second = (here + (following - here) * (part + k) / 4.0 for k in (0, 1))
            slope = first - 0.5 * speed - 0.4 * speed * abs(speed)
            ahead = speed + h * slope
            speed += 0.5 * h * (slope + second - 0.5 * ahead - 0.4 * ahead * abs(ahead))
    noise = torch.randn(samples, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    write_table(path, {"time": time, "torque": torque, "speed": torch.tensor(speeds).double() + NOISE * noise})
    return path


def measure(
    folder: Path, most: float, cpu_seconds: Callable[[Path, str], float], sizes: Sequence[int] = SAMPLES
) -> tuple[list[int], list[float]]:
    """Samples and CPU seconds, up to the first point that would in proportion take more than ``most`` seconds.

    Args:
        folder: folder of the recordings.
        most: largest CPU seconds of a point.
        cpu_seconds: runs the command on a recording with a simulation.
        sizes: samples, ascending.
    """
    written = folder / "rotor.py"
    written.write_text(ROTOR)
    samples: list[int] = []
    seconds: list[float] = []
    for size in sizes:
        if samples and seconds[-1] * size / samples[-1] > most:
            break
        seconds.append(cpu_seconds(rotor(folder / f"rotor_{size}.csv", size), f"{written}:Rotor"))
        samples.append(size)
        print(f"{size:>12,} samples{seconds[-1]:>10.1f} s of CPU", flush=True)
    return samples, seconds


def slope(samples: Sequence[int], seconds: Sequence[float]) -> float:
    """The exponent: slope of a straight line through the logarithms; nan for fewer than two points.

    Example:
        >>> round(slope([1000, 10_000, 100_000], [2.0, 20.0, 200.0]), 6)
        1.0
    """
    if len(samples) < 2:
        return math.nan
    return float(np.polyfit(np.log(samples), np.log(seconds), 1)[0])


def draw(path: Path, samples: Sequence[int], seconds: Sequence[float]) -> None:
    """Draw the points on logarithmic axes, with their exponent and a line in proportion to the samples."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5.6, 3.8), layout="constrained")
    ax = figure.subplots()
    ax.loglog(samples, seconds, "o-", label=f"mkc diagnose, exponent {slope(samples, seconds):.2f}")
    in_proportion = [seconds[0] * size / samples[0] for size in samples]
    ax.loglog(samples, in_proportion, ":", color="0.5", label="in proportion to the samples")
    ax.set_xlabel("samples")
    ax.set_ylabel("CPU seconds")
    ax.grid(visible=True, alpha=0.3)
    ax.legend(frameon=False)
    figure.savefig(path, dpi=130)
