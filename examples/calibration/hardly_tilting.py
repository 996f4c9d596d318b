"""Vehicles that hardly tilt, with a gyroscope or at a known place: `calibrate` and an ellipsoid by least squares.

python examples/calibration/hardly_tilting.py [--draws 200] [--by place] [--picture hardly_tilting.png]
"""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass
from pathlib import Path

import matplotlib.pyplot as plt
import torch
from rich.console import Console
from rich.table import Table
from torch import Generator, Tensor

from mkc_torch import NotIdentifiableError, Recording
from mkc_torch.calibration import calibrate
from mkc_torch.calibration.aided.place import Field
from mkc_torch.calibration.aided.rotation import from_quaternion
from mkc_torch.calibration.ellipsoid import ellipsoid_from_coefficients, monomials, symmetric_root

RATE, SECONDS = 50.0, 120.0
"""Sampling rate in Hz, and length in s."""

NOISE = 0.5
"""Noise of each axis of the magnetometer, µT."""

RATE_NOISE, RATE_BIAS, RATE_DRIFT, RATE_GAIN, RATE_TURNED = 0.01, 1.0, 0.003, 0.01, 0.01
"""A cheap gyroscope: noise in °/s/√Hz, standard deviation of the constant bias in °/s, drift of the bias over a
recording in °/s, and standard deviations of gains and of cross-axis sensitivity."""

DISTURBED = 0.1
"""Share of samples with a magnetic disturbance."""

JUDGED_FROM = 100_000
"""First seed of the scored draws; thresholds were set on lower seeds."""


@dataclass(frozen=True)
class Draw:
    """A simulated recording and its truth.

    Attributes:
        recording: time, magnetometer in µT, gyroscope in rad/s.
        to_world: (N, 3, 3), from the body to east, north, up.
        field: (3,), field in world axes, µT.
        offset, response: sensor parameters, ``measured = response @ field + offset``.
        tilt: largest angle from the vertical, °.
        disturbed: (N,), mask of disturbed samples.
    """

    recording: Recording
    to_world: Tensor
    field: Tensor
    offset: Tensor
    response: Tensor
    tilt: float
    disturbed: Tensor


def drawn(seed: int, least: float = 5.0, most: float = 20.0, seconds: float = SECONDS) -> Draw:
    """Simulate a vehicle that drives for two minutes; its largest tilt is drawn between two angles in °."""
    g = Generator().manual_seed(seed)
    count = round(seconds * RATE)
    time = torch.arange(count, dtype=torch.float64) / RATE
    tilt = math.radians(uniform(g, least, most))
    yaw_rate = uniform(g, 0.15, 0.6) * slow(g, count, 8.0)
    yaw = (
        2.0 * math.pi * uniform(g, 0.0, 1.0) + (yaw_rate.cumsum(0) + uniform(g, 0.05, 0.2) * torch.arange(count)) / RATE
    )
    lean = torch.stack([slow(g, count, uniform(g, 1.0, 5.0)) for _ in range(2)], -1)
    lean = tilt * lean / torch.linalg.vector_norm(lean, dim=-1).max()
    attitude = product(about(yaw, 2), product(about(lean[:, 1], 1), about(lean[:, 0], 0)))
    to_world = from_quaternion(attitude)
    strength, dip = uniform(g, 30.0, 60.0), math.radians(uniform(g, -70.0, 70.0))
    field = strength * torch.tensor([0.0, math.cos(dip), -math.sin(dip)], dtype=torch.float64)
    response = torch.eye(3, dtype=torch.float64) + 0.1 * (
        2.0 * torch.rand(3, 3, generator=g, dtype=torch.float64) - 1.0
    )
    offset = torch.nn.functional.normalize(normal(g, 3), dim=0) * strength * uniform(g, 0.0, 1.0)
    seen = (to_world.mT @ field) @ response.mT + offset + NOISE * normal(g, count, 3)
    disturbed = bursts(g, count)
    seen = seen + disturbances(g, count, disturbed)
    columns = {"time": time}
    columns |= dict(zip(("mag_x", "mag_y", "mag_z"), seen.unbind(-1), strict=True))
    columns |= dict(zip(("gyro_x", "gyro_y", "gyro_z"), rates(g, to_world).unbind(-1), strict=True))
    return Draw(
        Recording(columns, name=f"draw {seed}"), to_world, field, offset, response, math.degrees(tilt), disturbed
    )


def rates(g: Generator, to_world: Tensor) -> Tensor:
    """Return the rates of a cheap gyroscope, rad/s."""
    step = to_world[:-1].mT @ to_world[1:]
    skew = 0.5 * (step - step.mT)
    turn = torch.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], -1)
    sine = torch.linalg.vector_norm(turn, dim=-1, keepdim=True).clamp(min=1e-12)
    between = turn * torch.asin(sine.clamp(max=1.0)) / sine * RATE
    true = torch.cat([between[:1], 0.5 * (between[1:] + between[:-1]), between[-1:]])
    count = len(true)
    drift = normal(g, count, 3).cumsum(0) * RATE_DRIFT / math.sqrt(count)
    degrees = RATE_BIAS * normal(g, 3) + drift + RATE_NOISE * math.sqrt(RATE) * normal(g, count, 3)
    gains = torch.eye(3, dtype=torch.float64) + RATE_TURNED * normal(g, 3, 3)
    gains = gains - torch.diag(gains.diagonal()) + torch.diag(1.0 + RATE_GAIN * normal(g, 3))
    return true @ gains.mT + torch.deg2rad(degrees)


def bursts(g: Generator, count: int) -> Tensor:
    """Draw the disturbed samples: bursts of 0.5 to 4 s, and single samples."""
    hit = torch.rand(count, generator=g) < 0.2 * DISTURBED
    while float(hit.double().mean()) < DISTURBED:
        begin, length = int(uniform(g, 0.0, 1.0) * count), int(uniform(g, 0.5, 4.0) * RATE)
        hit[begin : begin + length] = True
    return hit


def disturbances(g: Generator, count: int, hit: Tensor) -> Tensor:
    """Draw the field of passing iron and currents, µT: constant in a burst, independent in single samples."""
    single = 15.0 * normal(g, count, 3)
    burst = torch.zeros(count, 3, dtype=torch.float64)
    number = torch.cat([torch.zeros(1), (hit[1:] != hit[:-1]).cumsum(0)]).long()
    for k in number[hit].unique().tolist():
        rows = (number == k).nonzero().flatten()
        swell = torch.sin(torch.linspace(0.1, math.pi - 0.1, len(rows), dtype=torch.float64))[:, None]
        burst[rows] = swell * 20.0 * normal(g, 3) if len(rows) > 3 else single[rows]
    return burst * hit[:, None]


def heading_errors(draw: Draw, offset: Tensor, matrix: Tensor) -> Tensor:
    """Return the heading errors of the corrected field at each attitude, °, for a compass with known tilt.

    Noise and disturbances are left out: the error is that of the calibration.
    """
    seen = (draw.to_world.mT @ draw.field) @ draw.response.mT + draw.offset
    field = (draw.to_world @ ((seen - offset) @ matrix.mT).unsqueeze(-1)).squeeze(-1)
    return torch.rad2deg(torch.atan2(field[:, 0], field[:, 1]))


def by_calibrate(draw: Draw) -> Tensor | None:
    """Return the heading errors of `calibrate`; None if it refuses."""
    try:
        found = calibrate(draw.recording)
    except NotIdentifiableError:
        return None
    return heading_errors(draw, torch.tensor(found.center).double(), torch.tensor(found.matrix).double())


def by_place(draw: Draw) -> Tensor | None:
    """Return the heading errors of `calibrate` at a known place without gyroscope, minus their mean.

    Lengths of the field do not determine a rotation of the sensor.
    """
    kept = {name: values for name, values in draw.recording.columns.items() if not name.startswith("gyro")}
    strength = float(torch.linalg.vector_norm(draw.field))
    earth = Field(strength, -math.asin(float(draw.field[2]) / strength), 0.0)
    try:
        found = calibrate(Recording(kept, name=draw.recording.name), earth=earth)
    except NotIdentifiableError:
        return None
    errors = heading_errors(draw, torch.tensor(found.center).double(), torch.tensor(found.matrix).double())
    radians = torch.deg2rad(errors)
    constant = torch.rad2deg(torch.atan2(radians.sin().mean(), radians.cos().mean()))
    return (errors - constant + 180.0) % 360.0 - 180.0


def by_least_squares(draw: Draw) -> Tensor | None:
    """Return the heading errors of an unchecked ellipsoid by least squares; None if the quadric is not an ellipsoid."""
    points = draw.recording.magnetometer()
    middle = points.mean(0)
    size = torch.linalg.vector_norm(points - middle, dim=-1).mean()
    rows = monomials((points - middle) / size)
    ellipsoid = ellipsoid_from_coefficients(torch.linalg.lstsq(rows, rows.new_ones(len(rows), 1)).solution[:, 0])
    if not bool((torch.linalg.eigvalsh(ellipsoid.shape) > 0).all()):
        return None
    return heading_errors(draw, middle + size * ellipsoid.center, symmetric_root(ellipsoid.shape))


WAYS = {"gyroscope": by_calibrate, "place": by_place}


def judged(draws: range, least: float, most: float, by: str = "gyroscope") -> dict[str, list[float]]:
    """Return the RMS heading error of each draw, °; infinite without a result."""
    ways = {f"calibrate, by the {by}": WAYS[by], "ellipsoid by least squares": by_least_squares}
    found: dict[str, list[float]] = {name: [] for name in ways}
    for seed in draws:
        draw = drawn(seed, least, most)
        for name, way in ways.items():
            errors = way(draw)
            found[name].append(math.inf if errors is None else float(errors.square().mean().sqrt()))
    return found


def row(name: str, sizes: list[float]) -> tuple[str, ...]:
    values = torch.tensor(sizes)
    within = float((values <= 2.0).double().mean())
    quantiles = [float(torch.quantile(values.clamp(max=180.0), q)) for q in (0.5, 0.95)]
    none = int(values.isinf().sum())
    return name, f"{100.0 * within:.1f} %", *(f"{q:.2f}°" for q in quantiles), str(none)


def picture(found: dict[str, list[float]], path: Path) -> None:
    """Return the share of draws with at most this error."""
    figure, axes = plt.subplots(figsize=(7.0, 4.2), layout="constrained")
    for name, sizes in found.items():
        ordered = sorted(min(size, 180.0) for size in sizes)
        share = [100.0 * (k + 1) / len(ordered) for k in range(len(ordered))]
        axes.step(ordered, share, where="post", label=name)
    axes.axvline(2.0, color="grey", lw=0.8)
    axes.set(
        xscale="log", xlabel="heading error, root mean square (°)", ylabel="share of draws (%)", xlim=(0.05, 180.0)
    )
    axes.legend(loc="lower right")
    figure.savefig(path, dpi=130)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=200)
    parser.add_argument("--tilt", type=float, nargs=2, default=(5.0, 20.0), metavar=("LEAST", "MOST"), help="in °")
    parser.add_argument(
        "--by", choices=sorted(WAYS), default="gyroscope", help="what is known in addition to the field"
    )
    parser.add_argument("--picture", type=Path, help="file to draw into")
    arguments = parser.parse_args()
    least, most = arguments.tilt
    found = judged(range(JUDGED_FROM, JUDGED_FROM + arguments.draws), least, most, arguments.by)
    table = Table(title=f"{arguments.draws} vehicles that tilt by {least:g} to {most:g}° at the most")
    for heading in ("", "heading error of 2° at the most", "median", "95 %", "no result"):
        table.add_column(heading, justify="right" if heading else "left")
    for name, sizes in found.items():
        table.add_row(*row(name, sizes))
    Console(width=110).print(table)
    if arguments.picture is not None:
        picture(found, arguments.picture)


def uniform(g: Generator, low: float, high: float) -> float:
    return low + (high - low) * float(torch.rand((), generator=g, dtype=torch.float64))


def normal(g: Generator, *shape: int) -> Tensor:
    return torch.randn(*shape, generator=g, dtype=torch.float64)


def slow(g: Generator, count: int, seconds: float) -> Tensor:
    """Draw a smooth path of standard deviation 1 with a time scale in s."""
    time = torch.arange(count, dtype=torch.float64) / RATE
    course = torch.zeros(count, dtype=torch.float64)
    for _ in range(12):
        pace = uniform(g, 0.1, 1.0) * 2.0 * math.pi / seconds
        course += math.sqrt(2.0 / 12.0) * torch.sin(pace * time + uniform(g, 0.0, 2.0 * math.pi))
    return course


def about(angle: Tensor, axis: int) -> Tensor:
    quaternion = torch.zeros(len(angle), 4, dtype=torch.float64)
    quaternion[:, 0], quaternion[:, 1 + axis] = torch.cos(0.5 * angle), torch.sin(0.5 * angle)
    return quaternion


def product(a: Tensor, b: Tensor) -> Tensor:
    w, v, x, u = a[:, :1], a[:, 1:], b[:, :1], b[:, 1:]
    return torch.cat([w * x - (v * u).sum(-1, keepdim=True), w * u + x * v + torch.linalg.cross(v, u)], -1)


if __name__ == "__main__":
    main()
