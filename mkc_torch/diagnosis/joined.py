"""Join the recordings of a diagnosis to one table."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from mkc_torch._support.arrays import is_frame
from mkc_torch.recording.given_columns import EXPERIMENT
from mkc_torch.recording.recording import Recording
from mkc_torch.recording.together import join_recordings, recording_names, refuse_no_recording
from mkc_torch.simulation.protocol import PreparedSimulation, Simulation

__all__ = ["joined", "run_counts", "with_own_offsets"]


def joined(simulation: Simulation, recording: Recording | Sequence[Recording]) -> tuple[Recording, tuple[str, ...]]:
    """Return one recording of all that were given, and their names; no names for a single recording.

    Raises:
        TypeError: neither a recording nor a list or tuple of recordings.
        RecordingError: no recording, or columns, units or labels that differ.
    """
    if isinstance(recording, Recording) or is_frame(recording) or not isinstance(recording, (list, tuple)):
        refuse_no_recording("recording", recording)
        assert isinstance(recording, Recording)
        return recording, ()
    for number, item in enumerate(recording):
        refuse_no_recording(f"recording[{number}]", item)
    whole = join_recordings(recording, simulation.joint_clock)
    return whole, recording_names(recording) if len(recording) > 1 else ()


def run_counts(recordings: Sequence[Recording]) -> tuple[int, ...]:
    """Return the number of runs in each recording."""
    return tuple(len(recording.experiments()) for recording in recordings)


def with_own_offsets(prepared: PreparedSimulation, recordings: Sequence[Recording]) -> PreparedSimulation:
    """Return the simulation with separate offsets of its outputs for each recording.

    A simulation without such offsets, such as the magnetometer's, is returned unchanged.
    """
    whole = prepared.recording
    if len(recordings) < 2 or EXPERIMENT not in whole:
        return prepared
    counts = torch.tensor(run_counts(recordings))
    of_experiment = torch.arange(len(recordings)).repeat_interleave(counts)
    recording, names = of_experiment[whole[EXPERIMENT].long()], recording_names(recordings)
    return prepared.with_own_offsets(recording, names)
