"""The interface of the corrected simulation that a diagnosis returns."""

from __future__ import annotations

from abc import abstractmethod
from pathlib import Path
from typing import TYPE_CHECKING

from torch import Tensor, nn

from mkc_torch.recording.recording import Recording

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["CorrectingModel"]


class CorrectingModel(nn.Module):
    """A simulation's sensor or system with the findings in it; see :class:`mkc_torch.diagnosis.DiagnosedModel`."""

    @abstractmethod
    def correct(self, recording: Recording) -> tuple[dict[str, Float[Tensor, " N"]], tuple[str, ...]]:
        """Return the corrected columns of a recording, and sentences about findings that do not transfer to it."""

    @abstractmethod
    def to_json(self) -> str:
        """Return the text of model.json."""

    @abstractmethod
    def to_python(self, module: str | None = None, folder: Path | None = None) -> str:
        """Return the simulation with the findings as Python source."""
