"""An FMU for model exchange as differential equations, like a user's own."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, TypeGuard

import numpy as np
import torch
from torch import Tensor

from mkc_torch.recording.recording import Recording
from mkc_torch.simulation.dynamics.definition import Dynamics
from mkc_torch.simulation.dynamics.missing import usable_rows
from mkc_torch.simulation.dynamics.prepared import PreparedDynamics
from mkc_torch.simulation.fmu.cosimulation import Simulated
from mkc_torch.simulation.fmu.description import Description, FmuError, FmuVariable, read_description
from mkc_torch.simulation.fmu.evaluation import Evaluation
from mkc_torch.simulation.foreign.evaluation import EvaluationPoints
from mkc_torch.simulation.foreign.function import evaluated
from mkc_torch.simulation.foreign.model_file import model_file
from mkc_torch.simulation.parameter import SimulationError

if TYPE_CHECKING:
    from numpy.typing import NDArray

_PROBES = 7
"""Number of points at which an FMU is tested."""


class FmuDynamics(Dynamics):
    """The equations of an FMU; :func:`fmu_class` makes a class of an FMU, with its names, parameters and units.

    All fixed and tunable real parameters are fitted, within min and max. A state that equals an output has the output's
    name. Columns of a recording may have the names in the FMU, "body.phi", or Python identifiers, "body_phi". The
    outputs and states that are columns of the recording are compared.

    Effects act outside the FMU: on its rates, its inputs and its outputs.

    Attributes:
        evaluation: evaluation of the FMU.
        of_states: names of the FMU's states; a derived class may have more states.
        shown: outputs that are not states: name to index among the FMU's outputs.
        labels: names of states, inputs and outputs in the FMU.
    """

    evaluation: ClassVar[Evaluation]
    of_states: ClassVar[tuple[str, ...]]
    shown: ClassVar[Mapping[str, int]]
    labels: ClassVar[Mapping[str, str]]

    def derivative(self, time: Tensor, x: Any, u: Any, p: Any) -> Mapping[str, Tensor]:
        rates = self._evaluated(False, time, x, u, p)
        return dict(zip(self.of_states, rates.unbind(-1), strict=True))

    def output(self, time: Tensor, x: Any, u: Any, p: Any) -> Mapping[str, Tensor]:
        found = dict(vars(x))
        names = [name for name in self.shown if not self.outputs or name in self.outputs]
        if names:
            values = self._evaluated(True, time, x, u, p)
            found |= {name: values[..., self.shown[name]] for name in names}
        return found

    def prepare(self, recording: Recording) -> PreparedDynamics:
        """The simulation together with a recording.

        Raises:
            MissingColumnError: the recording lacks ``time`` or an input.
            SimulationError: none of the outputs is a column of the recording.
        """
        recording = self._renamed(recording)
        known = (*self.shown, *self.of_states)
        measured = self.outputs or tuple(name for name in known if name in recording)
        if not measured:
            labels = ", ".join(dict.fromkeys(self.labels.get(name, name) for name in known))
            raise SimulationError(
                f"{self.name}: none of the FMU's outputs and states is a column of the recording. It has {labels}; the "
                f"recording has {', '.join(recording.names)}. Assign the columns with --columns NAME=COLUMN."
            )
        own = type(self)()
        own.__dict__.update(self.__dict__)
        own.outputs = measured
        return PreparedDynamics(own, usable_rows(recording, own.inputs, measured), measured)

    def __reduce__(self) -> Any:
        if is_of_an_fmu(type(self)):  # such a class cannot be imported by name
            return load_fmu, (str(self.evaluation.description.path),)
        return object.__reduce__(self)

    def _renamed(self, recording: Recording) -> Recording:
        """The recording with Python identifiers in place of the FMU's names of columns."""
        new = {label: name for name, label in self.labels.items() if label in recording and name not in recording}
        if not new:
            return recording
        return Recording(
            {new.get(name, name): values for name, values in recording.columns.items()},
            name=recording.name,
            units={new.get(name, name): unit for name, unit in recording.units.items()},
            warnings=recording.warnings,
            notes=recording.notes,
            labels={new.get(name, name): label for name, label in recording.labels.items()},
        )

    def _evaluated(self, outputs: bool, time: Tensor, x: Any, u: Any, p: Any) -> Tensor:
        states = torch.stack(torch.broadcast_tensors(*(getattr(x, name) for name in self.of_states)), -1)
        rows = states.shape[0]
        inputs = states.new_zeros(rows, 0)
        if self.inputs:
            inputs = torch.stack([getattr(u, name).expand(rows) for name in self.inputs], -1)
        known = [getattr(p, variable.name) for variable in self.evaluation.description.parameters]
        parameters = torch.stack(known) if known else states.new_zeros(0)
        return evaluated(self.evaluation, outputs, time.expand(rows), states, inputs, parameters)


def load_fmu(path: str | Path) -> FmuDynamics | Simulated:
    """Load the simulation in an FMU, whose binary is run.

    An FMU for co-simulation only has its own solver: it is compared like the output of a simulator.

    Raises:
        FmuError: the FMU cannot be used.
        ImportError: FMPy is not installed.
    """
    described = read_description(Path(path))
    return _class_of(described)() if described.exchange else Simulated(described)


def fmu_class(path: str | Path, file: str | None = None) -> type[FmuDynamics]:
    """A class of the equations in an FMU, to derive from like :class:`mkc_torch.simulation.Dynamics`.

    Args:
        path: path of the FMU.
        file: ``__file__`` of the calling file, to whose folder the path is relative; None for the current folder.

    Raises:
        FmuError: the FMU cannot be used, or is for co-simulation only.
        ImportError: FMPy is not installed.
    """
    place = model_file(path, file)
    described = read_description(place)
    if not described.exchange:
        raise FmuError(f"{place}: this FMU is for co-simulation only; export it for model exchange.")
    return _class_of(described)


def is_of_an_fmu(kind: type) -> TypeGuard[type[FmuDynamics]]:
    """Whether a class was made by :func:`fmu_class`, and not derived from such a class.

    Example:
        >>> is_of_an_fmu(dict)
        False
    """
    return issubclass(kind, FmuDynamics) and "evaluation" in vars(kind)


def _class_of(described: Description) -> type[FmuDynamics]:
    evaluation = Evaluation(described)
    if not evaluation.binary.begin([parameter.value for parameter in described.parameters.values()]):
        messages = "; ".join(evaluation.binary.messages)
        raise FmuError(
            f"{described.path}: the FMU cannot be initialised with its own start values"
            f"{f' ({messages})' if messages else ''}."
        )
    first = evaluation.binary.first_states()
    _refuse_memory(evaluation, first)
    evaluation.binary.timed = not (described.timeless and _is_timeless(evaluation, first))
    names = _names_of_states(evaluation, first)
    shown = {output.name: k for k, output in enumerate(described.outputs) if output.name not in names.values()}
    states = tuple(names.values())
    quantities = [*described.inputs, *described.outputs]
    labels = {quantity.name: quantity.label for quantity in quantities}
    labels |= {names[state]: state.label for state in described.states if names[state] not in labels}
    own = zip(described.states, states, strict=True)
    units = {quantity.name: quantity.unit for quantity in quantities if quantity.unit}
    units |= {name: state.unit for state, name in own if state.unit}
    body = {
        "__doc__": f"The equations of {described.path.name}.",
        "evaluation": evaluation,
        "of_states": states,
        "shown": shown,
        "labels": labels,
        "states": states,
        "inputs": tuple(variable.name for variable in described.inputs),
        "parameters": {variable.name: parameter for variable, parameter in described.parameters.items()},
        "units": units,
        "initial": dict(zip(states, first.tolist(), strict=True)),
    }
    return type(described.name, (FmuDynamics,), body)


def _probes(evaluation: Evaluation, first: NDArray[np.float64]) -> EvaluationPoints:
    """A few fixed random points near the FMU's initial states."""
    described = evaluation.description
    scattered = np.random.default_rng(0).uniform(0.1, 1.0, (_PROBES, len(first) + len(described.inputs)))
    n = len(first)
    states = first * (1.0 + 0.1 * scattered[:, :n]) + np.where(first == 0.0, scattered[:, :n], 0.0)
    values = np.array([parameter.value for parameter in described.parameters.values()])
    return EvaluationPoints(np.arange(_PROBES, dtype=np.float64), states, scattered[:, n:], values)


def _is_timeless(evaluation: Evaluation, first: NDArray[np.float64]) -> bool:
    """Whether rates and outputs do not depend on time; without setting the time, a third of the calls is saved."""
    if evaluation.description.events:
        return False
    time, states, inputs, parameters = _probes(evaluation, first).parts
    for outputs in (False, True):
        early, late = (
            evaluation.values(outputs, EvaluationPoints(time + shift, states, inputs, parameters)) for shift in (0, 0.7)
        )
        if not np.array_equal(early, late, equal_nan=True):
            return False
    return True


def _names_of_states(evaluation: Evaluation, first: NDArray[np.float64]) -> dict[FmuVariable, str]:
    """Names of the states: the name of an output that equals the state, else its own name."""
    described = evaluation.description
    names = {state: state.name for state in described.states}
    if described.outputs:
        at = _probes(evaluation, first)
        values = evaluation.values(True, at)
        for k, output in enumerate(described.outputs):
            for j, state in enumerate(described.states):
                if names[state] == state.name and np.array_equal(values[:, k], at.parts[1][:, j]):
                    names[state] = output.name
                    break
    return names


def _refuse_memory(evaluation: Evaluation, first: NDArray[np.float64]) -> None:
    """Refuse an FMU whose rates depend on previous evaluations: it has a discrete state that events change."""
    if not evaluation.description.events:
        return
    at = _probes(evaluation, first)
    time, states, inputs, parameters = at.parts
    plain = evaluation.values(False, at)
    back = evaluation.values(False, EvaluationPoints(time[::-1], states[::-1], inputs[::-1], parameters))[::-1]
    if not np.array_equal(plain, back, equal_nan=True):
        raise FmuError(
            f"{evaluation.description.path}: the FMU's rates depend on earlier events, as of a hysteresis or a clock, "
            "which a diagnosis cannot follow: let its tool simulate the recording, and give its output with "
            "`--simulator-output SIM.csv`."
        )
