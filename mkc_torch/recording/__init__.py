"""Recordings: tables of named columns, read from files, data frames or tensors, with warnings about their data."""

from mkc_torch.recording.demonstration import simulated_recording
from mkc_torch.recording.formats import MissingColumnError, RecordingError
from mkc_torch.recording.recording import Recording, write_table

__all__ = ["MissingColumnError", "Recording", "RecordingError", "simulated_recording", "write_table"]
