"""State of a streamed fit between two passes; its size does not depend on the number of rows."""

from __future__ import annotations

import io
import os
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from mkc_torch._support.files import write_atomically
from mkc_torch.linear._descent import PassDerivatives
from mkc_torch.linear._implicit.stationary import FitState
from mkc_torch.linear.streaming._batches import Shape
from mkc_torch.linear.streaming._pilot import PilotFit
from mkc_torch.linear.streaming._survey import Survey

if TYPE_CHECKING:
    from jaxtyping import Float64

FORMAT = 4
"""Version of a saved state; another version is refused."""

_CLASSES: dict[str, Any] = {
    "survey": Survey,
    "shape": Shape,
    "pilot": PilotFit,
    "fit_state": FitState,
    "slopes": PassDerivatives,
}
"""Types of the nested parts of a state, by the name of the field."""


@dataclass(frozen=True)
class StreamState:
    """A fit between two passes: a resumed fit repeats the steps between the recorded passes, not the passes.

    Attributes:
        settings: parameters of the fit, by name.
        survey: the survey of all rows.
        pilot: the pilot fit.
        passes: point and sums of each pass after the survey.
    """

    settings: dict[str, Any]
    survey: Survey
    pilot: PilotFit
    passes: tuple[tuple[Float64[Tensor, " p"], Float64[Tensor, " k"]], ...] = ()

    def state_dict(self) -> dict[str, Any]:
        """Return the state as numbers, texts and tensors, readable by ``torch.load(..., weights_only=True)``."""
        return {"format": FORMAT, **_plain(self)}

    @staticmethod
    def of(state: dict[str, Any]) -> StreamState:
        """Restore from :meth:`state_dict`.

        Raises:
            ValueError: not such a state.
        """
        if not isinstance(state, dict) or state.get("format") != FORMAT:
            raise ValueError(
                "Expected a state of StreamedMKCRegression, of this version, but got something else; start over "
                "without it."
            )
        return StreamState(**{key: _restored(key, value) for key, value in state.items() if key != "format"})

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the state to a file atomically."""
        buffer = io.BytesIO()
        torch.save(self.state_dict(), buffer)
        write_atomically(path, buffer.getvalue(), overwrite=True)

    @staticmethod
    def load(path: str | os.PathLike[str]) -> StreamState | None:
        """Read the state from a file; None if there is no file.

        Raises:
            ValueError: the file holds something else.
        """
        if not Path(path).exists():
            return None
        try:
            state = torch.load(path, weights_only=True)
        except OSError:  # an unreadable file is not a damaged file
            raise
        except Exception as error:  # torch raises various errors for foreign files
            raise ValueError(
                f"Expected argument `checkpoint` to be a checkpoint of StreamedMKCRegression but {path} is not, or is "
                "damaged; delete it to start over, or choose another name."
            ) from error
        return StreamState.of(state)

    def refuse_other_settings(self, settings: dict[str, Any]) -> None:
        """Refuse to resume a fit that was made with other parameters.

        Raises:
            ValueError: they differ.
        """
        for name, value in settings.items():
            if self.settings.get(name) != value:
                raise ValueError(
                    f"Expected argument `{name}` as in the saved state, {self.settings.get(name)!r}, but got "
                    f"{value!r}; use that value, or start over without the state."
                )


def _plain(value: Any) -> Any:
    """Nested parts of a state as dictionaries."""
    if is_dataclass(value):
        return {field.name: _plain(getattr(value, field.name)) for field in fields(value)}
    if hasattr(value, "_asdict"):
        return {name: _plain(part) for name, part in value._asdict().items()}
    return value


def _restored(name: str, value: Any) -> Any:
    if name not in _CLASSES or not isinstance(value, dict):
        return value
    return _CLASSES[name](**{key: _restored(key, part) for key, part in value.items()})
