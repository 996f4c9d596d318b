"""Recordings: tables of named columns, read from files, data frames or tensors, with warnings about their data."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mkc_torch.recording.demonstration import simulated_recording
    from mkc_torch.recording.formats import MissingColumnError, RecordingError
    from mkc_torch.recording.recording import Recording, write_table

__all__ = ["MissingColumnError", "Recording", "RecordingError", "simulated_recording", "write_table"]

_HOMES = {
    "MissingColumnError": "formats",
    "Recording": "recording",
    "RecordingError": "formats",
    "simulated_recording": "demonstration",
    "write_table": "recording",
}

if not TYPE_CHECKING:

    def __getattr__(name: str) -> Any:
        # the formats need no torch, whose import takes longer than to refuse a file
        if name not in _HOMES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
