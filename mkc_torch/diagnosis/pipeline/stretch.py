"""The stretches of a long recording that a diagnosis of differential equations or of a simulation that steps uses."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.recording.given_columns import EXPERIMENT
from mkc_torch.recording.recording import Recording
from mkc_torch.simulation.protocol import PreparedSimulation
from mkc_torch.simulation.runs import experiment_runs

if TYPE_CHECKING:
    from jaxtyping import Float

MOST = 1000
"""Samples of a stretch. By judgement: a fit of each effect takes a simulation of all of them tens of times."""

LONG = 10_000
"""Samples of differential equations that a diagnosis uses. By its cost: a pendulum takes 200 CPU seconds and 2.5 GB."""

_LENGTH = 2000
"""Samples of each of its stretches, up to twice as many."""

_ROUNDING = 1e-9
"""Relative difference of a column's levels from which they count as different."""

_PLACES = 4
"""Stretches that are compared start at each quarter of their length."""


def quick_stretch(prepared: PreparedSimulation, recording: Recording) -> Recording | None:
    """Return the stretch of a run in which the outputs move most, for a simulation that steps; None for any other.

    Args:
        prepared: the simulation with the whole recording.
        recording: as given by the user.
    """
    system = prepared.dynamics
    if system is None or system.system.steps is None or len(prepared.time) <= MOST or int(system.begins.sum()) > 1:
        return None
    first = first_of_liveliest(system.measured, MOST)
    last = first + MOST
    begin, end = (float(prepared.time[row]) for row in (first, last - 1))
    note = (
        f"Quick look at {MOST} of {len(prepared.time)} samples, from {begin:.4g} to {end:.4g} s, where the outputs "
        "move most. Leave out --quick (in Python quick=True) to use all."
    )
    columns = {name: recording[name][first:last] for name in recording.names}
    return Recording(
        columns,
        name=recording.name,
        units=recording.units,
        labels=recording.labels,
        warnings=recording.warnings,
        notes=(*recording.notes, note),
    )


def first_of_liveliest(values: Float[Tensor, "N m"], length: int) -> int:
    """Return the first row of the stretch of a length in which the columns change most, each in its own scale.

    Example:
        >>> still, moving = torch.zeros(80, 1), torch.sin(torch.arange(40.0)).unsqueeze(-1)
        >>> first_of_liveliest(torch.cat([still, moving, still]), 40)
        80
    """
    known = values.nan_to_num()
    moved = (known.diff(dim=0).abs() / known.std(0).clamp(min=1e-300)).sum(-1).cumsum(0)
    starts = range(0, len(values) - length + 1, max(length // _PLACES, 1))
    return max(starts, key=lambda row: float(moved[row + length - 2] - (moved[row - 1] if row else 0.0)))


def in_stretches(recordings: Sequence[Recording]) -> tuple[Recording, ...]:
    """Return recordings of differential equations in stretches of about :data:`LONG` samples; shorter ones as they are.

    Args:
        recordings: all that are diagnosed together; each keeps a share, and at least one stretch.
    """
    total = sum(map(len, recordings))
    if total <= LONG:
        return tuple(recordings)
    return tuple(within_stretches(each, LONG * len(each) // total, _LENGTH) for each in recordings)


def within_stretches(recording: Recording, most: int, length: int) -> Recording:
    """Return the stretches of a recording whose levels and movements differ most, as runs of their own.

    The first is where the columns move most; each further stretch is the one farthest from those before it, by the mean
    and the standard deviation of each column. So the rare levels and the rare events are among them.

    Args:
        recording: with ``time``; a stretch lies within one of its runs.
        most: samples from which no stretch is added.
        length: samples of a stretch, up to twice as many; fewer in a shorter run.

    Example:
        >>> time = torch.arange(60.0)
        >>> table = Recording({"time": time, "speed": torch.where((time > 30.0) & (time < 40.0), 5.0, 0.1 * time)})
        >>> found = within_stretches(table, 20, 10)
        >>> found["time"].tolist()[::10], found.labels["experiment"]
        ([0.0, 30.0], ('0 to 9 s', '30 to 39 s'))
    """
    run = experiment_runs(recording)
    spans = [
        (first + (last - first) * k // count, first + (last - first) * (k + 1) // count)
        for first, last in _spans(run)
        for count in [max((last - first) // length, 1)]
        for k in range(count)
    ]
    chosen = _most_different(recording, spans, most)
    parts: list[tuple[int, int]] = []
    for first, last in sorted(spans[k] for k in chosen):
        follows = bool(parts) and parts[-1][1] == first and bool(run[first - 1] == run[first])
        parts = [*parts[:-1], (parts[-1][0], last)] if follows else [*parts, (first, last)]
    rows = torch.cat([torch.arange(first, last) for first, last in parts])
    time, columns = recording["time"], {name: recording[name][rows] for name in recording.names if name != EXPERIMENT}
    labels = tuple(f"{float(time[first]):.6g} to {float(time[last - 1]):.6g} s" for first, last in parts)
    number = torch.arange(len(parts)).repeat_interleave(torch.tensor([last - first for first, last in parts]))
    note = (
        f"The diagnosis uses {len(rows)} of {len(recording)} samples, in {len(parts)} stretches of different levels "
        f"and movements: {', '.join(labels)}. `mkc apply` uses all."
    )
    return Recording(
        {**columns, EXPERIMENT: number.double()},
        name=recording.name,
        units={name: unit for name, unit in recording.units.items() if name != EXPERIMENT},
        labels={**{k: v for k, v in recording.labels.items() if k != EXPERIMENT}, EXPERIMENT: labels},
        warnings=recording.warnings,
        notes=(*recording.notes, note),
    )


def _spans(run: Tensor) -> list[tuple[int, int]]:
    """First row and end of each run."""
    edges = [0, *(run.diff().nonzero().squeeze(-1) + 1).tolist(), len(run)]
    return list(itertools.pairwise(edges))


def _most_different(recording: Recording, spans: Sequence[tuple[int, int]], most: int) -> list[int]:
    """Numbers of the spans, the liveliest first and then the farthest in turn."""
    names = [name for name in recording.names if name not in ("time", EXPERIMENT)]
    table = torch.stack([recording[name].double() for name in names], -1).nan_to_num()
    levels = torch.stack([table[first:last].mean(0) for first, last in spans])
    moves = torch.stack([table[first:last].std(0, correction=0) for first, last in spans])
    features = torch.cat([levels, moves], 1)
    spread = features.std(0, correction=0)
    differs = spread > _ROUNDING * features.abs().amax(0)
    features = torch.where(differs, (features - features.mean(0)) / torch.where(differs, spread, 1.0), 0.0)
    size = table.std(0, correction=0)
    chosen = [int(torch.where(size > 0.0, moves / size.clamp(min=1e-300), 0.0).sum(1).argmax())]
    away = (features - features[chosen[0]]).norm(dim=1)
    while sum(spans[k][1] - spans[k][0] for k in chosen) < most and float(away.max()) > 0.0:
        chosen.append(int(away.argmax()))
        away = torch.minimum(away, (features - features[chosen[-1]]).norm(dim=1))
    return chosen
