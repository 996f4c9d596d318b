"""How often effects that MuJoCo's own elements make are named at the right joint, with the right size.

``python -m tests.gate.each_joint_effect --per-effect 5 --output DIR`` steps an arm of two links with five times finer
steps than its file has and with one element more, adds an encoder's resolution, noise and outliers, and diagnoses the
recordings with the file. A diagnosis that the folder has is not repeated.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from subprocess import run
from typing import Any

import numpy as np
import torch

from examples.blind_proof.mujoco import elements
from examples.blind_proof.mujoco.elements import Element
from examples.blind_proof.mujoco.robots import ROBOTS
from mkc_torch.recording.recording import write_table

ARM = ROBOTS["arm"].xml
"""The arm as its file has it."""

FINER = 5
"""Steps of the recorded arm in a step of the file."""

SAMPLES, SAMPLE_S = 300, 0.02
NOISE_RAD, ENCODER_BITS, OUTLIERS = 0.001, 13, 0.02


@dataclass(frozen=True)
class Hidden:
    """An element that the file lacks.

    Attributes:
        effect: id of the effect that it is.
        channel: where it acts, as findings state it.
        sizes: smallest and largest size that is drawn, in the unit of the finding.
        parameter: name of the finding's parameter that is the size.
        write: adds it to MuJoCo's specification; the second argument is the size.
    """

    effect: str
    channel: str
    sizes: tuple[float, float]
    parameter: str
    write: Callable[[Any, float], None]


def _length(spec: Any, size: float) -> None:
    spec.body("fore").pos = [0.0, 0.0, -0.4 - size]


def _shaft(spec: Any, size: float) -> None:
    """Add a wheel on a flexible shaft at the shoulder, with a frequency of 4 Hz."""
    wheel = spec.body("upper").add_body(name="wheel")
    wheel.explicitinertial, wheel.mass, wheel.inertia = True, 1e-3, [size] * 3
    stiffness = size * (2.0 * np.pi * 4.0) ** 2
    wheel.add_joint(name="shaft", axis=[0.0, 1.0, 0.0], stiffness=stiffness, damping=0.01 * stiffness)


def _hidden(element: Element, parameter: str = "change") -> Hidden:
    return Hidden(element.effect, element.at[0], element.sizes, parameter, element.write)


HIDDEN: Mapping[str, Hidden] = {
    "friction": _hidden(elements.friction("elbow", (0.03, 0.08)), "friction"),
    "stop": _hidden(elements.stop("elbow", (0.3, 0.5)), ""),
    "lag": _hidden(elements.lag("second", (0.03, 0.08)), "lag"),
    "limit": _hidden(elements.limit("first", (1.2, 1.8)), "limit"),
    "load": _hidden(elements.payload("fore", (0.0, 0.0, -0.15), (0.05, 0.15))),
    "length": Hidden("constant_change", "constant fore_distance", (0.02, 0.06), "change", _length),
    "tilt": _hidden(elements.tilt((0.03, 0.1))),
    "zero": _hidden(elements.zero("elbow", (0.05, 0.15))),
    "inertia": _hidden(elements.inertia("elbow", (0.003, 0.01))),
    "shaft": Hidden("hidden_mode", "input shoulder_force", (0.05, 0.15), "inertia", _shaft),
}


def recorded(kind: str, index: int, seed: int) -> tuple[float, dict[str, torch.Tensor]]:
    """Draw a size, and return it with the columns of a recording.

    Args:
        kind: name in ``HIDDEN``.
        index: number of the recording.
        seed: of all draws.
    """
    import mujoco

    random = np.random.default_rng([seed, list(HIDDEN).index(kind), index])
    size = float(random.uniform(*HIDDEN[kind].sizes))
    spec = mujoco.MjSpec.from_string(ARM)
    HIDDEN[kind].write(spec, size)
    spec.option.timestep /= FINER
    model = spec.compile()
    data = mujoco.MjData(model)
    time = SAMPLE_S * np.arange(SAMPLES)
    phase, speed = random.uniform(0.0, 6.0, (2, 2)), random.uniform(0.8, 1.2, (2, 2))
    slow, fast = np.sin(2.0 * speed[0] * time[:, None] + phase[0]), np.sin(5.5 * speed[1] * time[:, None] + phase[1])
    control = np.array([2.0, 0.3]) * slow + np.array([1.2, 0.25]) * fast
    angles = np.empty((SAMPLES, 2))
    for row in range(SAMPLES):
        angles[row] = data.joint("shoulder").qpos[0], data.joint("elbow").qpos[0]
        data.ctrl[:] = control[row]
        mujoco.mj_step(model, data, round(SAMPLE_S / model.opt.timestep))
    digit = 2.0 * np.pi / 2**ENCODER_BITS
    shown = digit * np.round((angles + NOISE_RAD * random.normal(size=angles.shape)) / digit)
    wrong = random.random(angles.shape) < OUTLIERS
    shown = np.where(wrong, shown + random.uniform(-1.0, 1.0, angles.shape), shown)
    columns = {"time": time, "first": control[:, 0], "second": control[:, 1]}
    columns |= {"shoulder": shown[:, 0], "elbow": shown[:, 1]}
    return size, {name: torch.tensor(values) for name, values in columns.items()}


def judged(content: Mapping[str, Any], hidden: Hidden, size: float) -> tuple[bool, str]:
    """Return whether the first finding is the hidden element, and a text with its size.

    Args:
        content: of ``diagnosis.json``.
        hidden: the element.
        size: its size.
    """
    findings = content["findings"]
    if not findings:
        return False, f"{content['verdict']}: no name"
    first = findings[0]
    right = first["effect"] == hidden.effect and hidden.channel in first["channels"]
    sizes = [p for p in first["parameters"] if p["name"] == hidden.parameter]
    text = f"{first['effect']} at {', '.join(first['channels'])}"
    if not sizes:
        return right, text
    value, error = (float(np.ravel(sizes[0][key])[0]) for key in ("value", "standard_error"))
    return right, f"{text}, {value:.4g} ± {error:.2g}, true {size:.4g}, off by {abs(value - size) / error:.1f} errors"


def measure(kinds: Sequence[str], per_effect: int, seed: int, output: Path, options: Sequence[str]) -> None:
    """Draw, diagnose, and print a line for each recording and each element."""
    output.mkdir(parents=True, exist_ok=True)
    (output / "arm.xml").write_text(ARM, encoding="utf-8")
    totals = dict.fromkeys(kinds, 0)
    for kind in kinds:
        for index in range(per_effect):
            name = f"{kind}_{index}"
            size, columns = recorded(kind, index, seed)
            file = output / name / "diagnosis.json"
            if not file.is_file():
                write_table(output / f"{name}.csv", columns)
                files = [str(output / f"{name}.csv"), "--simulation", str(output / "arm.xml"), "--output", str(output)]
                run([sys.executable, "-m", "mkc_torch.cli", "diagnose", *files, "--force", *options], check=False)
            right, text = judged(json.loads(file.read_text(encoding="utf-8")), HIDDEN[kind], size)
            totals[kind] += right
            print(f"{name} | {'right' if right else 'WRONG'} | {text}", flush=True)
    print("\n| element | named right |\n|---|---:|")
    for kind, right in totals.items():
        print(f"| {kind} | {right} of {per_effect} |")


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--elements", nargs="+", choices=list(HIDDEN), default=list(HIDDEN), metavar="NAME")
    parser.add_argument("--per-effect", type=int, default=5, help="recordings of each element (default: 5)")
    parser.add_argument("--seed", type=int, default=21)
    parser.add_argument("--output", type=Path, required=True, help="folder for recordings and diagnoses")
    parser.add_argument("--whole", action="store_true", help="with p-values; default: a quick look")
    options = parser.parse_args(arguments)
    measure(options.elements, options.per_effect, options.seed, options.output, () if options.whole else ("--quick",))
    return 0


if __name__ == "__main__":
    sys.exit(main())
