"""Run ``corrected.py`` alone: simulate a recording with the findings, and print its residuals."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from mkc_torch.diagnosis.io.model import DiagnosedModel
from mkc_torch.diagnosis.validation.blocks import block_numbers, block_squares
from mkc_torch.diagnosis.validation.predict import Prediction, predict
from mkc_torch.recording.recording import Recording, write_table
from mkc_torch.simulation.dynamics import Dynamics
from mkc_torch.simulation.parameter import known_parameters


def run_alone(kind: type[Dynamics], arguments: Sequence[str] | None = None) -> None:
    """Predict a recording by a corrected simulation, as ``mkc check`` does, and print the RMSE of each output.

    Args:
        kind: class of the corrected simulation, with the fitted parameters.
        arguments: of the command line: the recording, ``--start-seconds``, ``--output``, and ``--sizes-of`` where
            sizes differ between the diagnosed recordings; None for those of the process.

    Raises:
        SystemExit: wrong arguments (2), or a recording that cannot be simulated (1).
    """
    parser = argparse.ArgumentParser(description=f"Simulate a recording by {kind.__name__} and print the residuals.")
    parser.add_argument("recording", metavar="NEW.csv", type=Path)
    parser.add_argument("--start-seconds", type=float, help="start from which the initial states are estimated")
    parser.add_argument("--output", type=Path, help="file for the simulated outputs, .csv or .parquet")
    own: str | None = getattr(kind, "sizes_of", None)
    if own is not None:
        parser.add_argument("--sizes-of", default=own, help="diagnosed recording whose sizes apply")
    given = parser.parse_args(arguments)
    try:
        system: Any = kind()
        if own is not None:
            system.sizes_of = given.sizes_of
        found = predict(plain_model(system), Recording.read(given.recording, recognise=False), given.start_seconds)
        if given.output is not None:
            write_table(given.output, simulated_columns(found))
    except (ValueError, OSError) as error:
        sys.exit(f"{given.recording}: {error}")
    print(summary(found))


def plain_model(system: Dynamics) -> DiagnosedModel:
    """Return a simulation with its own parameters and hold as a model without findings."""
    values = [parameter.value for parameter in known_parameters(system.name, system.parameters).values()]
    holds = dict.fromkeys(system.inputs, system.input_hold)
    return DiagnosedModel(system.name, {"input_hold": holds}, torch.tensor(values, dtype=torch.float64), (), (), system)


def simulated_columns(found: Prediction) -> dict[str, torch.Tensor]:
    """Return ``time``, and each output as ``NAME_simulated``."""
    each = zip(found.outputs, found.simulated.detach().unbind(-1), strict=True)
    return {"time": found.time} | {f"{name}_simulated": values for name, values in each}


def summary(found: Prediction) -> str:
    """Return the RMSE of each output over the predicted samples, a line each."""
    block = block_numbers(found.run, found.predicted)
    lines = [f"initial states from the first {found.start_seconds:.6g} s; RMSE of the predicted samples:"]
    for name, unit, residual in zip(found.outputs, found.units, found.residual.detach().unbind(-1), strict=True):
        lines.append(f"{name}: {block_squares(residual, block).rmse:.9g} {unit}".rstrip())
    return "\n".join(lines)
