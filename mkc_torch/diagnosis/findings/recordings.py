"""Runs and offsets of several recordings."""

from __future__ import annotations

import math
from collections.abc import Sequence

from mkc_torch.diagnosis.environment import Offset, Run
from mkc_torch.diagnosis.goodness_of_fit import units_of
from mkc_torch.diagnosis.linearised.estimate import FinalEstimate
from mkc_torch.simulation.protocol import PreparedSimulation

__all__ = ["offsets_of", "runs_of"]


def offsets_of(final: FinalEstimate, names: Sequence[str]) -> tuple[Offset, ...]:
    """Return the offsets of each output in each recording, for outputs with a fitted offset.

    Args:
        final: the fit with all findings.
        names: of the recordings.
    """
    prepared = final.fit.model.prepared
    own = prepared.own_offsets
    units, error = dict(zip(prepared.channels, units_of(prepared), strict=True)), final.standard_error
    row = {name: k for k, name in enumerate(prepared.parameter_names)}
    fitted = {(offset.output, offset.recording): row[offset.name] for offset in own}
    sentences = []
    for output in dict.fromkeys(offset.output for offset in own):
        for number, name in enumerate(names):
            at = fitted.get((output, number))
            value = 0.0 if at is None else float(final.fit.parameters[at])
            sentences.append(
                Offset(output, units[output], number + 1, name, value, math.nan if at is None else float(error[at]))
            )
    return tuple(sentences)


def runs_of(prepared: PreparedSimulation, names: Sequence[str], counts: Sequence[int]) -> tuple[Run, ...]:
    """Return the runs, in the order of a finding's shares; empty for a single run or unknown runs.

    Args:
        prepared: the simulation.
        names: of the recordings; empty for a single recording.
        counts: number of runs per recording; empty for a single recording.
    """
    system = prepared.dynamics
    if system is None or int(system.run.max()) < 1:
        return ()
    if not names:
        return tuple(Run(0, "", number + 1) for number in range(int(system.run.max()) + 1))
    each = [
        Run(number, name, run + 1 if count > 1 else 0)
        for number, (name, count) in enumerate(zip(names, counts, strict=True), start=1)
        for run in range(count)
    ]
    first = (system.run.diff(prepend=system.run[:1] - 1) != 0).nonzero().flatten()
    return tuple(each[int(number)] for number in prepared.recording["experiment"][first])
