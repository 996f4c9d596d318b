"""Starts of trajectories: of runs, and of the segments that long runs are split into."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.recording.recording import Recording
from mkc_torch.simulation.dynamics.equations import Equations
from mkc_torch.simulation.parameter import SimulationError

if TYPE_CHECKING:
    from jaxtyping import Bool, Int

_FEWEST = 3
"""Samples of a trajectory at least."""


def beginnings(recording: Recording, system: Equations) -> tuple[Tensor, list[str]]:
    """Mask of the samples where trajectories start, (N,), and a label for each trajectory."""
    time = recording["time"]
    begins = torch.zeros(len(time), dtype=torch.bool)
    begins[0] = True
    many = "experiment" in recording
    if many:
        group = recording["experiment"]
        begins[1:] |= group[1:] != group[:-1]
    if system.restart_after is not None:
        first = torch.where(begins, torch.arange(len(time)), 0).cummax(0).values
        number = ((time - time[first]) / system.restart_after).floor()
        begins[1:] |= number[1:] != number[:-1]
        begins &= ~_short_ends(begins, first)
    labels = []
    for row in begins.nonzero().squeeze(-1).tolist():
        label = ""
        if many:
            names = recording.labels.get("experiment")
            value = int(recording["experiment"][row])
            label = f" of {names[value] if names else value}"
        if system.restart_after is not None:
            label += f", {float(time[row]):.4g} s"
        labels.append(label)
    return begins, labels


def _short_ends(begins: Bool[Tensor, " N"], first: Int[Tensor, " N"]) -> Bool[Tensor, " N"]:
    """Mask of the starts of last segments that are too short for a trajectory of their own."""
    short = torch.zeros_like(begins)
    rows = begins.nonzero().squeeze(-1)
    ends = torch.cat([rows[1:], rows.new_tensor([len(begins)])])
    last = torch.cat([first[1:] != first[:-1], first.new_ones(1).bool()])
    short[rows] = last[ends - 1] & (ends - rows < _FEWEST) & (rows != first[rows])
    return short


def refuse_few(begins: Tensor, name: str) -> None:
    """Raise where a trajectory has fewer than three samples."""
    first = begins.nonzero().squeeze(-1)
    shortest = int(torch.cat([first, first.new_tensor([len(begins)])]).diff().min())
    if shortest < _FEWEST:
        raise SimulationError(
            f"{name}: a run of {shortest} samples is too short for a trajectory; expected at least {_FEWEST}. Leave "
            "it out, or use longer segments (`restart_after`)."
        )
