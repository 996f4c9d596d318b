"""Vehicles that hardly tilt, from the example."""

import importlib.util
import sys
from functools import cache
from pathlib import Path

import torch

from mkc_torch import Recording

NAME = "hardly_tilting"


@cache
def example():
    path = Path(__file__).parents[3] / "examples" / "calibration" / "hardly_tilting.py"
    spec = importlib.util.spec_from_file_location(NAME, path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[NAME] = module  # its dataclass looks its own module up
    spec.loader.exec_module(module)
    return module


def quaternions(to_world):
    """w, x, y, z of rotations of less than half a turn, computed from the largest of the four."""
    m = to_world
    diagonal = m.diagonal(dim1=-2, dim2=-1)
    w = (1.0 + diagonal.sum(-1)).clamp(min=0.0).sqrt() / 2.0
    x, y, z = ((1.0 + 2.0 * diagonal[:, k] - diagonal.sum(-1)).clamp(min=0.0).sqrt() / 2.0 for k in range(3))
    sign = torch.sign(m[:, 1, 0] - m[:, 0, 1])
    return torch.stack(
        [w, x * torch.sign(m[:, 2, 1] - m[:, 1, 2]), y * torch.sign(m[:, 0, 2] - m[:, 2, 0]), z * sign], -1
    )


def with_columns(recording, drop=(), **columns):
    kept = {name: values for name, values in recording.columns.items() if name not in drop}
    return Recording({**kept, **columns}, name="vehicle")
