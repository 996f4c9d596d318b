"""The subject of a proof: how its cases are drawn, its thresholds, and the baselines."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from torch import Tensor

from mkc_torch.challenge.key import Key
from mkc_torch.challenge.thresholds import Threshold
from mkc_torch.recording.recording import Recording

Ratio = Callable[[Mapping[str, Tensor], Recording, Key], float]
"""Returns the residual relative to the oracle's, given the corrected second recording, the recording and its key."""

Baseline = Callable[[Path], Mapping[str, Any] | None]
"""Returns the content of ``diagnosis.json`` by a simple method, given the recording's file; None if it fails."""


@dataclass(frozen=True)
class Case:
    """A drawn case. ``second`` is another recording of the same sensor with the same effect; None for an empty case."""

    recording: Recording
    second: Recording | None
    key: Key


@dataclass(frozen=True)
class Subject:
    """A family of simulations. Its functions are top-level functions, so that other processes can import them.

    Attributes:
        name: value of ``--family``.
        cases, empty: default numbers of recordings with and without hidden physics.
        draw: returns a case, given the seed, the index, and whether it is empty.
        ratio: residual of a corrected second recording, relative to the oracle's.
        thresholds: thresholds of the proof.
        baselines: simple methods to compare with, by name.
        settings: settings that are printed with the result.
        simulations: a Python file that is copied next to the recordings for the diagnosis.
    """

    name: str
    cases: int
    empty: int
    draw: Callable[[int, int, bool], Case]
    ratio: Ratio
    thresholds: Sequence[Threshold]
    baselines: Mapping[str, Baseline] = field(default_factory=dict)
    settings: Mapping[str, Any] = field(default_factory=dict)
    simulations: Path | None = None
