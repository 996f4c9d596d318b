"""What a diagnosis leaves for other recordings, as its result knows it."""

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
    """A simulation's sensor or system with the findings in it; :class:`mkc_torch.diagnosis.DiagnosedModel` is one."""

    @abstractmethod
    def correct(self, recording: Recording) -> tuple[dict[str, Float[Tensor, " N"]], tuple[str, ...]]:
        """The corrected columns of a recording, and sentences about what does not carry over."""

    @abstractmethod
    def to_json(self) -> str:
        """The text of model.json."""

    @abstractmethod
    def to_python(self, module: str | None = None, folder: Path | None = None) -> str:
        """The simulation with the findings as Python."""
