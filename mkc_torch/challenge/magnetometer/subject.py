"""The proof of the magnetometer."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from torch import Tensor

from mkc_torch.challenge.key import Key
from mkc_torch.challenge.magnetometer.baselines import stepwise_bic
from mkc_torch.challenge.magnetometer.generator import draw
from mkc_torch.challenge.magnetometer.motion import DURATION
from mkc_torch.challenge.magnetometer.second import ratio_to_oracle
from mkc_torch.challenge.subject import Case, Subject
from mkc_torch.challenge.thresholds import THRESHOLDS
from mkc_torch.recording.recording import Recording


def magnetometer(duration: float = DURATION) -> Subject:
    """Return the subject: recordings of a magnetometer with a duration in s."""
    return Subject(
        name="magnetometer",
        cases=240,
        empty=400,
        draw=partial(_draw, duration),
        ratio=_ratio,
        thresholds=THRESHOLDS,
        baselines={"Least squares, stepwise BIC": _stepwise},
        settings={"duration_s": duration},
    )


def _draw(duration: float, seed: int, index: int, empty: bool) -> Case:
    return draw(seed, index, empty=empty, duration=duration)


def _ratio(corrected: Mapping[str, Tensor], second: Recording, key: Key) -> float:  # noqa: ARG001 - one signature
    return ratio_to_oracle(corrected, key)


def _stepwise(path: Path) -> Mapping[str, Any] | None:
    return stepwise_bic(Recording.read(path))
