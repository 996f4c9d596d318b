"""An FMU for co-simulation only: simulated by its own solver, and compared like a simulator's output."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from mkc_torch.recording.join_recordings import Clock
from mkc_torch.recording.recording import Recording
from mkc_torch.simulation.fmu.description import Description, FmuError, the_library
from mkc_torch.simulation.paired import Paired, PairedCorrection, PreparedPaired
from mkc_torch.simulation.parameter import SimulationError

if TYPE_CHECKING:
    from torch import Tensor


class Simulated:
    """An FMU with its own solver, driven by a recording's inputs; its parameters are not fitted.

    Args:
        description: description of the FMU.
    """

    name = Paired.name
    joins_experiments = True
    measured: frozenset[str] = frozenset()
    joint_clock: Clock = "restart"

    def __init__(self, description: Description) -> None:
        self.description = description

    @property
    def columns(self) -> frozenset[str]:
        variables = (*self.description.inputs, *self.description.outputs)
        return frozenset({"time", "experiment", *(variable.label for variable in variables)})

    def prepare(self, recording: Recording) -> PreparedPaired:
        """The FMU's output for the recording's inputs, together with the recording.

        Raises:
            MissingColumnError: the recording lacks ``time`` or an input.
            SimulationError: it cannot be simulated, or none of its outputs is a column of the recording.
        """
        return Paired(self.simulated(recording)).prepare(recording)

    def correction(self, state: Mapping[str, Any], recording: Recording) -> PairedCorrection:
        """The FMU's output with corrections for a new recording."""
        return Paired(self.simulated(recording)).correction(state, recording)

    def simulated(self, recording: Recording) -> Recording:
        """The simulated outputs that are columns of the recording, and the inputs, at its times."""
        description = self.description
        outputs = [output.label for output in description.outputs if output.label in recording]
        if not outputs:
            raise SimulationError(
                f"{description.path}: none of the FMU's outputs is a column of the recording. It has "
                f"{', '.join(output.label for output in description.outputs) or 'none'}; the recording has "
                f"{', '.join(recording.names)}. Assign the columns with --columns NAME=COLUMN."
            )
        inputs = [variable.label for variable in description.inputs]
        table = recording.finite("time", *inputs)
        runs = table["experiment"] if "experiment" in table else torch.zeros(len(table))
        parts = [self._run(table, runs == run, inputs, outputs) for run in runs.unique(sorted=True)]
        names = ["time", *outputs, *inputs]
        columns = {name: torch.cat([part[name] for part in parts]) for name in names}
        labels = {}
        if "experiment" in table:
            columns["experiment"] = torch.cat([part["experiment"] for part in parts])
            labels = {name: label for name, label in table.labels.items() if name == "experiment"}
        return Recording(columns, name=description.path.stem, labels=labels)

    def _run(self, table: Recording, rows: Tensor, inputs: list[str], outputs: list[str]) -> dict[str, Tensor]:
        time, order = table["time"][rows].sort()
        first = float(time[0])
        given = {name: table[name][rows][order] for name in inputs}
        signals = None
        if inputs:
            kinds = [("time", np.float64), *((name, np.float64) for name in inputs)]
            signals = np.zeros(len(time), dtype=kinds)
            signals["time"] = (time - first).numpy()
            for name in inputs:
                signals[name] = given[name].numpy()
        step = float(time.diff().median()) if len(time) > 1 else 1.0
        try:
            found = the_library().simulate_fmu(
                str(self.description.path),
                fmi_type="CoSimulation",
                start_time=0.0,
                stop_time=float(time[-1]) - first,
                output_interval=step,
                input=signals,
                output=outputs,
                logger=lambda *_: None,
            )
        except Exception as error:  # FMPy raises a plain Exception for most failures
            reason = " ".join(str(error).split())
            raise FmuError(f"{self.description.path}: its simulation failed: {reason}.") from None
        at = torch.from_numpy(np.ascontiguousarray(found["time"])).double()
        columns = {name: torch.from_numpy(np.ascontiguousarray(found[name])).double() for name in outputs}
        columns |= {
            name: torch.from_numpy(np.interp(at.numpy(), (time - first).numpy(), values.numpy()))
            for name, values in given.items()
        }
        own = {"experiment": torch.full_like(at, float(table["experiment"][rows][0]))} if "experiment" in table else {}
        return {"time": at + first, **columns, **own}
