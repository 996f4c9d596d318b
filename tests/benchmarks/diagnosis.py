"""Wall and CPU seconds and memory of `mkc diagnose` from the shell: `python -m tests.benchmarks.diagnosis`.

Each row is one command, with its start and its reports. A row is left out if its recording, outside of this repository,
is absent; the file name is printed. `--only` takes rows whose name begins with the given text. `--samples PICTURE`
draws CPU seconds over the samples of a recording instead.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from unittest.mock import patch

import torch
from torch import Tensor

from mkc_torch.cli.console import DOUBTFUL
from mkc_torch.recording import demonstration
from mkc_torch.recording.recording import write_table
from tests.benchmarks import samples

CASES = Path(__file__).resolve().parents[3] / "shared" / "cases"
SYSTEMS = {
    "altitude": ("runs.csv", "Altitude"),
    "ball_beam": ("run.csv", "Ball"),
    "coastdown": ("runs.csv", "Coast"),
    "gear_motor": ("runs.csv", "GearMotor"),
    "heater": ("runs.csv", "Heater"),
    "tanks": ("fit.csv", "Tanks"),
}
CART = """
from mkc_torch.simulation import Dynamics


class Cart(Dynamics):
    states = ("place", "speed", "motor")
    inputs = ("voltage",)
    parameters = {"damping": 0.5, "lag": 0.2, "gain": 1.0}

    def derivative(self, time, x, u, p):
        driven = (p.gain * u.voltage - x.motor) / p.lag
        return {"place": x.speed, "speed": x.motor - p.damping * x.speed, "motor": driven}

    def output(self, time, x, u, p):
        return {"place": x.place, "speed": x.speed}
"""


@dataclass(frozen=True)
class Row:
    """A command, with its limits in seconds and GiB."""

    name: str
    files: tuple[Path, ...]
    simulation: str
    seconds: float
    memory: float = 2.0


def sensor(path: Path, rate: float, seconds: float, seed: int, *, attitude: bool = False) -> Path:
    """A magnetometer turned by hand while a loudspeaker passes, at ``rate`` Hz; optionally with quaternions."""
    with patch.object(demonstration, "SECONDS", seconds), patch.object(demonstration, "RATE", rate):
        recording, _ = demonstration.simulated_recording(seed)
    columns = dict(recording.columns)
    if attitude:
        body_to_earth = demonstration._hand_rotation(columns["time"]).mT
        columns |= dict(zip(("q_w", "q_x", "q_y", "q_z"), quaternions(body_to_earth).unbind(-1), strict=True))
    write_table(path, columns)
    return path


def quaternions(rotation: Tensor) -> Tensor:
    """(N, 4) of rotations (N, 3, 3): the greatest eigenvector of Bar-Itzhack's matrix (2000)."""
    r = rotation
    K = torch.zeros(len(r), 4, 4, dtype=r.dtype)
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        K[:, i, i] = r[:, i, i] - r[:, j, j] - r[:, k, k]
        K[:, i, j] = K[:, j, i] = r[:, i, j] + r[:, j, i]
        K[:, 3, i] = K[:, i, 3] = r[:, k, j] - r[:, j, k]
    K[:, 3, 3] = r.diagonal(dim1=-2, dim2=-1).sum(-1)
    vector = torch.linalg.eigh(K).eigenvectors[..., -1]
    return torch.cat([vector[:, 3:], vector[:, :3]], -1)


def cart(path: Path, count: int) -> Path:
    """A motor drives a cart with quadratic drag that the simulation leaves out, at 50 Hz."""
    h = 0.02
    time_ = h * torch.arange(count, dtype=torch.float64)
    voltage = torch.sin(1.3 * time_) + torch.sin(0.31 * time_) + torch.sign(torch.sin(0.17 * time_))
    place = speed = motor = 0.0
    found = []
    for u in voltage.tolist():
        found.append((place, speed))
        for _ in range(4):
            place += 0.25 * h * speed
            speed += 0.25 * h * (motor - 0.5 * speed - 0.4 * speed * abs(speed))
            motor += 0.25 * h * (u - motor) / 0.2
    noise = torch.randn(count, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    noisy = torch.tensor(found, dtype=torch.float64) + 0.005 * noise
    write_table(path, {"time": time_, "voltage": voltage, "place": noisy[:, 0], "speed": noisy[:, 1]})
    return path


def of_cases(name: str) -> Callable[[Path], tuple[Path, ...]]:
    return lambda _: (CASES / name / SYSTEMS[name][0],)


def rows(folder: Path, only: str) -> Iterator[Row]:
    """Yield the rows whose name begins with ``only``, after their recordings are written."""
    written = folder / "cart.py"
    written.write_text(CART)
    magnetometer = "magnetometer"
    known: dict[str, tuple[Callable[[Path], tuple[Path, ...]], str, float]] = {
        "90 s at 50 Hz, length": (lambda f: (sensor(f / "length.csv", 50, 90, 0),), magnetometer, 4),
        "90 s at 50 Hz, attitude": (
            lambda f: (sensor(f / "attitude.csv", 50, 90, 0, attitude=True),),
            magnetometer,
            6,
        ),
        "1 h at 100 Hz, length": (lambda f: (sensor(f / "hour.csv", 100, 3600, 0),), magnetometer, 60),
        "thirty of 90 s at 50 Hz": (
            lambda f: tuple(sensor(f / f"of_thirty_{k}.csv", 50, 90, k) for k in range(30)),
            magnetometer,
            45,
        ),
        "three states, 10,000 samples": (lambda f: (cart(f / "cart.csv", 10_000),), f"{written}:Cart", 20),
        "three states, 1,000 samples": (lambda f: (cart(f / "cart_short.csv", 1_000),), f"{written}:Cart", 20),
    }
    known |= {
        f"case {name}": (of_cases(name), f"{CASES / name / 'naive.py'}:{kind}", 10)
        for name, (_, kind) in SYSTEMS.items()
    }
    for name, (make, simulation, seconds) in known.items():
        if name.startswith(only):
            files = make(folder)
            absent = [str(file) for file in files if not file.exists()]
            if absent:
                print(f"{name:<32} left out: {absent[0]} is absent", flush=True)
                continue
            yield Row(name, files, simulation, seconds)


def measured(row: Row, output: Path) -> tuple[float, float, float]:
    """Wall seconds, CPU seconds and peak memory in GiB of the largest process of a command."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    command = [sys.executable, "-m", "mkc_torch.cli", "diagnose", *map(str, row.files)]
    command += ["--simulation", row.simulation, "--output", str(output), "--force"]
    before, begin = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    wall, after = time.perf_counter() - begin, resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode not in (0, DOUBTFUL):
        raise RuntimeError(f"mkc diagnose of {row.name} failed:\n{done.stderr}")
    cpu = after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime
    return wall, cpu, after.ru_maxrss / 2**20


def over_samples(picture: Path, most: float) -> None:
    """Print and draw CPU seconds over samples, and print the exponent."""
    with tempfile.TemporaryDirectory() as folder:
        output = Path(folder) / "reports"

        def cpu_seconds(recording: Path, simulation: str) -> float:
            return measured(Row(recording.stem, (recording,), simulation, most), output)[1]

        sizes, seconds = samples.measure(Path(folder), most, cpu_seconds)
    print(f"exponent {samples.slope(sizes, seconds):.2f}")
    samples.draw(picture, sizes, seconds)


def main() -> None:
    """Print the table, or draw the picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", default="", help="only rows whose name begins with this text")
    parser.add_argument(
        "--samples", type=Path, metavar="PICTURE", help="draw CPU seconds over samples as a PNG instead"
    )
    parser.add_argument("--seconds", type=float, default=600.0, help="largest CPU seconds of a point of --samples")
    options = parser.parse_args()
    if options.samples is not None:
        over_samples(options.samples, options.seconds)
        return
    only = options.only
    print(f"{'':<32}{'wall':>9}{'limit':>8}{'CPU':>9}{'GiB so far':>12}")
    with tempfile.TemporaryDirectory() as folder:
        for row in rows(Path(folder), only):
            wall, cpu, memory = measured(row, Path(folder) / "reports")
            print(f"{row.name:<32}{wall:7.1f} s{row.seconds:6.0f} s{cpu:7.1f} s{memory:12.2f}", flush=True)


if __name__ == "__main__":
    main()
