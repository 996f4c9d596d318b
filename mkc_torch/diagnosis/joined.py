"""What is diagnosed: a recording, or several as one table."""

from __future__ import annotations

from collections.abc import Sequence

from mkc_torch._support.arrays import is_frame
from mkc_torch.recording.recording import Recording
from mkc_torch.recording.together import Clock, join_recordings, recording_names
from mkc_torch.simulation.paired import Paired
from mkc_torch.simulation.protocol import Simulation, refuse_no_recording

__all__ = ["joined"]


def joined(simulation: Simulation, recording: Recording | Sequence[Recording]) -> tuple[Recording, tuple[str, ...]]:
    """One recording of what was given, and the names of those in it; no names of a single one.

    Raises:
        TypeError: neither a recording nor a list or tuple of recordings.
        RecordingError: no recording, or columns, units or labels that differ.
    """
    if isinstance(recording, Recording) or is_frame(recording) or not isinstance(recording, (list, tuple)):
        refuse_no_recording("recording", recording)
        assert isinstance(recording, Recording)
        return recording, ()
    for number, one in enumerate(recording):
        refuse_no_recording(f"recording[{number}]", one)
    whole = join_recordings(recording, _clock(simulation))
    return whole, recording_names(recording) if len(recording) > 1 else ()


def _clock(simulation: Simulation) -> Clock:
    """What runs' times do beside one another, so that the simulation keeps the runs apart."""
    if isinstance(simulation, Paired):  # each sample is compared with what the simulator wrote at its time
        return "own"
    return "restart" if getattr(simulation, "joins_experiments", False) else "follow"
