"""What a proof is about: how its cases are drawn, what is asked of them, and what stands beside the diagnosis."""

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
"""From what a corrected model makes of a second recording, that recording and its key: residual over the oracle's."""

Naive = Callable[[Path], Mapping[str, Any] | None]
"""What a naive competitor would write into ``diagnosis.json`` of a recording's file; None where it fails."""


@dataclass(frozen=True)
class Case:
    """``second`` is of the same sensor in another motion, with the effect still acting; None for an empty case."""

    recording: Recording
    second: Recording | None
    key: Key


@dataclass(frozen=True)
class Subject:
    """One family of simulations. Its functions are those of modules, which other processes can import.

    Attributes:
        name: as a user asks for it.
        cases, empty: recordings with something hidden and with nothing, by default.
        draw: the case of a seed and an index, which is ``empty`` or not.
        ratio: how well a second recording is corrected.
        thresholds: what is asked for.
        baselines: naive competitors by their names.
        settings: what of it is printed with the result.
        simulations: a Python file that the diagnosis is given a copy of, beside the recordings.
    """

    name: str
    cases: int
    empty: int
    draw: Callable[[int, int, bool], Case]
    ratio: Ratio
    thresholds: Sequence[Threshold]
    baselines: Mapping[str, Naive] = field(default_factory=dict)
    settings: Mapping[str, Any] = field(default_factory=dict)
    simulations: Path | None = None
