"""A servo with a pendulum, simulated with viscous friction alone: found at two controller gains, proven at two others.

Data: Duclusaud et al., "Extended Friction Models for the Physics Simulation of Servo Actuators", ICRA 2025,
arXiv:2410.08650, github.com/Rhoban/bam, Apache-2.0.
"""

from __future__ import annotations

from pathlib import Path

import torch
from held_out import arguments, picture, prove, told

from mkc_torch import Recording
from mkc_torch.simulation import Dynamics, Parameter

EVERY = 8
"""Of the samples one in so many is used: they come at 190 Hz."""


class Servo(Dynamics):
    """A motor behind a proportional controller, which turns a pendulum."""

    states = ("position", "speed")
    inputs = ("goal_position", "voltage", "kp", "torque_enable")
    outputs = ("position",)
    units = {"position": "rad", "speed": "rad/s"}
    starts_from = 0.1
    parameters = {
        "drive": Parameter(10.0, lower=0.0),
        "damping": Parameter(6.0, lower=0.0, unit="1/s"),
        "gravity": Parameter(75.0, lower=0.0, unit="1/s²"),
        "gain": Parameter(0.005, lower=0.0),
    }

    def derivative(self, time, x, u, p):
        duty = torch.clamp(p.gain * u.kp * (u.goal_position - x.position), -1.0, 1.0) * u.torque_enable
        pull = p.gravity * torch.sin(x.position)
        return {"position": x.speed, "speed": p.drive * duty * u.voltage - p.damping * x.speed - pull}


def runs(folder: Path, gains: tuple[int, ...]) -> Recording:
    """All runs at these gains in one table."""
    columns: dict[str, list[torch.Tensor]] = {}
    files = [(path, gain) for gain in gains for path in sorted(folder.glob(f"*_kp{gain}.csv"))]
    for number, (path, gain) in enumerate(files):
        run = Recording.read(path)
        one = {name: run[name][::EVERY] for name in ("time", "position", "goal_position", "voltage", "torque_enable")}
        one["kp"] = torch.full_like(one["time"], float(gain))
        one["experiment"] = torch.full_like(one["time"], float(number))
        for name, values in one.items():
            columns.setdefault(name, []).append(values)
    return Recording({name: torch.cat(parts) for name, parts in columns.items()})


def main() -> None:
    options = arguments(__doc__.splitlines()[0])
    folder = options.data / "servo"
    (proof,) = prove(Servo(), runs(folder, (100, 400)), [runs(folder, (200, 800))], max_findings=1)
    before, after = proof.mean_absolute()
    print(f"{told(proof.diagnosis)}\nopen loop at the other gains: {before:.3f} -> {after:.3f} rad")
    if options.output:
        picture(proof, options.output, "The first runs at a gain that the fit has not seen", "rad", slice(0, 400))


if __name__ == "__main__":
    main()
