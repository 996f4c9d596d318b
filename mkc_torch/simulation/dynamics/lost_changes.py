"""Changes of inputs at samples that are left out because an output is missing there."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from mkc_torch.recording.recording import Recording

CHANGE = 0.1
"""Smallest change at a sample that is reported, as a share of the input's range. Judgement."""


def lost_changes(recording: Recording, inputs: Sequence[str], outputs: Sequence[str]) -> tuple[str, ...]:
    """Return a sentence for each input that changes at samples where an output is not finite.

    Without these samples the simulation gets the change later: the input there is neither its previous value nor
    between its neighbours.

    Example:
        >>> nan = float("nan")
        >>> columns = {"u": torch.tensor([0.0, 0.0, 1.0, 1.0]), "y": torch.tensor([0.0, 0.1, nan, 0.3])}
        >>> lost_changes(Recording(columns), ["u"], ["y"])[0][:44]
        '`u` changes at 1 of the dropped samples, and'
    """
    missing = ~recording.stack(*outputs).isfinite().all(-1)[1:-1]
    sentences = []
    for name in inputs:
        values = recording[name]
        before, here, after = values[:-2], values[1:-1], values[2:]
        away = torch.minimum((here - before).abs(), (here - 0.5 * (before + after)).abs())
        known = values[values.isfinite()]
        reach = float(known.amax() - known.amin()) if len(known) else 0.0
        count = int((missing & (away > CHANGE * reach)).sum())
        if count:
            sentences.append(
                f"`{name}` changes at {count} of the dropped samples, and the simulation gets these changes late. To "
                "keep them, fill the missing outputs, for example by interpolation."
            )
    return tuple(sentences)
