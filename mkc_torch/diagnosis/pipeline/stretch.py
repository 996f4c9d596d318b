"""The stretches of a long recording that a diagnosis of a simulation with states uses."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import torch
from torch import Tensor

from mkc_torch.recording.given_columns import EXPERIMENT
from mkc_torch.recording.recording import Recording
from mkc_torch.simulation.runs import experiment_runs

LONG = 10_000
"""Samples of differential equations that a diagnosis uses. By its cost: a pendulum takes 200 CPU seconds and 2.5 GB."""

LONG_STEPPED = 1500
"""The same of a simulation that steps, a fit of which takes tens of simulations of all samples at 0.1 ms each."""

QUICK_STEPPED = 1000
"""The same of a quick look."""

_LENGTH = 2000
"""Samples of a stretch of differential equations, up to twice as many."""

_LENGTH_STEPPED = 500
"""The same of a simulation that steps."""

_ROUNDING = 1e-9
"""Relative difference of a column's levels from which they count as different."""


def in_stretches(recordings: Sequence[Recording], *, stepped: bool, quick: bool = False) -> tuple[Recording, ...]:
    """Return recordings of a simulation with states in their most different stretches; short recordings as they are.

    Args:
        recordings: all that are diagnosed together; each keeps a share, and at least one stretch.
        stepped: whether the simulation steps, instead of giving rates of change.
        quick: whether the diagnosis is a quick look.
    """
    most, length = (QUICK_STEPPED if quick else LONG_STEPPED, _LENGTH_STEPPED) if stepped else (LONG, _LENGTH)
    total = sum(map(len, recordings))
    if total <= most:
        return tuple(recordings)
    return tuple(within_stretches(each, most * len(each) // total, length) for each in recordings)


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
    stretches = "a stretch" if len(parts) == 1 else f"{len(parts)} stretches of different levels and movements"
    note = (
        f"The diagnosis uses {len(rows)} of {len(recording)} samples, in {stretches}: {', '.join(labels)}. `mkc apply` "
        "uses all."
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
