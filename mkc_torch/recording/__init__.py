"""Recordings: tables with named columns, from files and tensors, and what is noticed of them."""

from mkc_torch.recording.demonstration import simulated_recording
from mkc_torch.recording.formats import MissingColumnError, RecordingError
from mkc_torch.recording.recording import Recording, write_table

__all__ = ["MissingColumnError", "Recording", "RecordingError", "simulated_recording", "write_table"]
