"""Write the tables that the README and the manual name: small, with an effect to find."""

from __future__ import annotations

import math
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path

import torch
from torch import Tensor

from mkc_torch.recording import write_table

# these tests import the simulated sensors only here
from mkc_torch.recording.demonstration import concealed_recording, simulated_recording
from tests.docs.pages import ROOT, blocks
from tests.simulation.fmu.made import COMPILER, PENDULUM, make_fmu

DRAG = 0.35
"""Quadratic drag of the pendulum in 1/rad; the simulation leaves it out."""


def write_examples(folder: Path) -> None:
    """Write all tables, under the names that the pages use."""
    recording, another = (simulated_recording(seed)[0].columns for seed in (0, 1))
    renamed = {{"mag_x": "mx", "mag_y": "my", "mag_z": "mz"}.get(name, name): v for name, v in recording.items()}
    simulated, recorded = paired(0)
    new_simulated, new_recorded = paired(1)
    for name, columns in {
        "RECORDING": recording,
        "ANOTHER": another,
        "RENAMED": renamed,
        "broad_28_stationary_magnet": recording,
        "FLIGHT": concealed_recording(0).columns,
        "BENCH": concealed_recording(2).columns,
        "NEW": concealed_recording(1).columns,
        "VEHICLE": vehicle_recording(),
        "SIDES": accelerometer_recording(),
        "SUPPLY": supply_recording(),
        "RUNS": joined(pendulum(0), pendulum(1)),
        "NEW_RUN": pendulum(2),
        "SIM": simulated,
        "REC": recorded,
        "NEW_SIM": new_simulated,
        "NEW_REC": new_recorded,
    }.items():
        write_table(folder / f"{name}.csv", columns)
    if COMPILER is not None:
        make_fmu(folder / "pendulum.fmu", PENDULUM)
    if find_spec("mujoco") is not None:
        write_swing(folder)


def write_swing(folder: Path, name: str = "SWING", samples: int = 250, friction: float = 0.06, seed: int = 0) -> None:
    """Write the manual's model for MuJoCo, and a recording of the same model with dry friction at its joint."""
    import mujoco

    text = next(block.text for block in blocks(ROOT / "docs" / "mujoco.md") if block.language == "xml")
    (folder / "swing.xml").write_text(text, encoding="utf-8")
    spec = mujoco.MjSpec.from_string(text)
    spec.joints[0].frictionloss = friction
    spec.option.timestep = 0.002
    model = spec.compile()
    data, draw = mujoco.MjData(model), torch.Generator().manual_seed(seed)
    drive = 0.5 * torch.randn(samples // 25, generator=draw, dtype=torch.float64).repeat_interleave(25)
    angles = []
    for command in drive.tolist():
        angles.append(float(data.qpos[0]))
        data.ctrl[0] = command
        for _ in range(10):
            mujoco.mj_step(model, data)
    hinge = torch.tensor(angles, dtype=torch.float64) + 0.002 * torch.randn(samples, generator=draw)
    time = 0.02 * torch.arange(samples, dtype=torch.float64)
    write_table(folder / f"{name}.csv", {"time": time, "drive": drive, "hinge": hinge})


def vehicle_recording(samples: int = 1500, rate: float = 25.0) -> dict[str, Tensor]:
    """Return a recording of a magnetometer and a gyroscope that tilt by ten degrees and rotate about the vertical."""
    draw = torch.Generator().manual_seed(0)
    time = torch.arange(samples, dtype=torch.float64) / rate
    lean, zero = 0.17 * torch.sin(0.9 * time), torch.zeros(samples, dtype=torch.float64)
    yaw = 0.4 * time
    # about z, then about x
    north = torch.stack([yaw.sin(), yaw.cos() * lean.cos(), -yaw.cos() * lean.sin()], -1)
    up = torch.stack([zero, lean.sin(), lean.cos()], -1)
    field = 20.0 * north - 43.0 * up + 0.3 * torch.randn(samples, 3, generator=draw)
    rates = torch.stack([0.153 * torch.cos(0.9 * time), zero, zero], -1) + 0.4 * up
    rates = rates + 0.002 * torch.randn(samples, 3, generator=draw)
    names = ("mag_x", "mag_y", "mag_z", "gyro_x", "gyro_y", "gyro_z")
    columns = torch.cat([field + torch.tensor([10.0, -5.0, 20.0]), rates], -1).unbind(-1)
    return {"time": time, **dict(zip(names, columns, strict=True))}


def accelerometer_recording() -> dict[str, Tensor]:
    """Return a recording of an accelerometer, turned in all directions."""
    draw = torch.Generator().manual_seed(0)
    way = torch.nn.functional.normalize(torch.randn(400, 3, generator=draw, dtype=torch.float64), dim=-1)
    force = 9.80665 * way * torch.tensor([1.01, 0.99, 1.0]) + torch.tensor([0.1, -0.2, 0.05])
    force = force + 0.01 * torch.randn(400, 3, generator=draw)
    return dict(zip(("accel_x", "accel_y", "accel_z"), force.unbind(-1), strict=True))


def supply_recording() -> dict[str, Tensor]:
    """Return a recording of a sensor whose offset follows a voltage."""
    columns = dict(concealed_recording(3).columns)
    voltage = 12.0 + torch.sin(0.23 * columns["time"]) + 0.5 * torch.sin(1.1 * columns["time"])
    del columns["current"]
    return columns | {"mag_x": columns["mag_x"] + 0.9 * voltage, "voltage": voltage}


def pendulum(number: int, samples: int = 150, rate: float = 20.0) -> dict[str, Tensor]:
    """Return a recording of a driven pendulum with air drag; the noise of its angle is 5 mrad."""
    noise = torch.randn(samples, generator=torch.Generator().manual_seed(number), dtype=torch.float64)
    time = torch.arange(samples, dtype=torch.float64) / rate
    torque = 1.2 * torch.sin(0.9 * time + number) + torch.sin(2.7 * time + 2 * number)
    angle, speed, angles, step = 0.3 + 0.5 * number, 0.0, [], 1.0 / (20.0 * rate)
    for k in range(samples):
        angles.append(angle)
        for part in range(20):
            u = float(torch.lerp(torque[k], torque[min(k + 1, samples - 1)], part / 20.0))
            speed += step * (u - 9.0 * math.sin(angle) - 0.1 * speed - DRAG * speed * abs(speed))
            angle += step * speed
    return {"time": time, "torque": torque, "angle": torch.tensor(angles, dtype=torch.float64) + 0.005 * noise}


def joined(*runs: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Runs in one table, distinguished by ``experiment``."""
    number = torch.cat([torch.full_like(run["time"], k) for k, run in enumerate(runs)])
    return {name: torch.cat([run[name] for run in runs]) for name in runs[0]} | {"experiment": number}


def paired(number: int, samples: int = 300) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Return a simulation and a recording, which is larger by eight per cent and depends slightly on temperature."""
    noise = torch.randn(samples, generator=torch.Generator().manual_seed(number), dtype=torch.float64)
    time = torch.arange(samples, dtype=torch.float64) / 20.0
    temperature = 20.0 + 5.0 * torch.sin(0.3 * time + number) + 0.2 * time
    angle = torch.sin(1.3 * time + number) + 0.3 * torch.sin(3.1 * time)
    recorded = 1.08 * angle + 0.004 * (temperature - 20.0) + 0.01 * noise
    return {"time": time, "angle": angle}, {"time": time, "angle": recorded, "temperature": temperature}
