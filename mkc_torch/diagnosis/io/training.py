"""What model.json holds of the recordings that a model was fitted to."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class BlockSquares:
    """Mean squares of a residual in consecutive blocks of a recording.

    Attributes:
        squares: (B,), mean square of each block, in the output's unit squared.
        samples: (B,), number of samples of each block.

    Example:
        >>> BlockSquares((1.0, 4.0), (30, 10)).rmse
        1.3228756555322954
    """

    squares: tuple[float, ...]
    samples: tuple[int, ...]

    @property
    def rmse(self) -> float:
        """Root mean square over all samples; nan without samples."""
        count = sum(self.samples)
        total = sum(square * n for square, n in zip(self.squares, self.samples, strict=True))
        return math.sqrt(total / count) if count else math.nan


@dataclass(frozen=True)
class OutputTraining:
    """Residuals of an output in the diagnosed recording, predicted as in a check.

    Attributes:
        baseline: without the findings.
        corrected: with the findings.
    """

    baseline: BlockSquares
    corrected: BlockSquares


@dataclass(frozen=True)
class Training:
    """The recordings that a model was fitted to, and the simulation without findings.

    Attributes:
        parameters: (p,), of the simulation alone, fitted to the same recordings.
        state: constants of that fit, such as the holds of its inputs.
        fingerprints: of each run of the recordings, see :func:`mkc_torch.diagnosis.validation.fingerprint.of_runs`.
        outputs: residuals by output; empty where the model could not be simulated as in a check.
    """

    parameters: tuple[float, ...]
    state: Mapping[str, Any]
    fingerprints: tuple[str, ...] = ()
    outputs: Mapping[str, OutputTraining] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """Return the content as values of JSON.

        Example:
            >>> Training.from_dict(Training((1.5,), {"class": "Tank"}, ("ab",)).to_dict()).parameters
            (1.5,)
        """
        return {
            "parameters": list(self.parameters),
            "state": dict(self.state),
            "fingerprints": list(self.fingerprints),
            "outputs": {
                name: {
                    "samples": list(each.baseline.samples),
                    "baseline": list(each.baseline.squares),
                    "corrected": list(each.corrected.squares),
                }
                for name, each in self.outputs.items()
            },
        }

    @staticmethod
    def from_dict(content: Mapping[str, Any]) -> Training:
        """Read the content of model.json.

        Raises:
            KeyError, TypeError, ValueError: a value is missing, of the wrong type, or no finite number.
        """
        outputs = {}
        for name, each in content["outputs"].items():
            samples = tuple(int(count) for count in each["samples"])
            baseline, corrected = (BlockSquares(_finite(each[key]), samples) for key in ("baseline", "corrected"))
            if not len(baseline.squares) == len(corrected.squares) == len(samples):
                raise ValueError(f"blocks of `{name}` differ in number")
            outputs[name] = OutputTraining(baseline, corrected)
        fingerprints = tuple(str(text) for text in content["fingerprints"])
        return Training(_finite(content["parameters"]), dict(content["state"]), fingerprints, outputs)


def _finite(values: Sequence[float]) -> tuple[float, ...]:
    numbers = tuple(float(value) for value in values)
    if not all(map(math.isfinite, numbers)):
        raise ValueError("training has a number that is not finite")
    return numbers
