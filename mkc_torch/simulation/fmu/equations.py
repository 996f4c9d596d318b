"""An FMU for model exchange as differential equations like a user's own."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, TypeGuard

import numpy as np
import torch
from torch import Tensor

from mkc_torch.recording.recording import Recording
from mkc_torch.simulation.dynamics.definition import Dynamics
from mkc_torch.simulation.dynamics.prepared import PreparedDynamics
from mkc_torch.simulation.fmu.cosimulation import Simulated
from mkc_torch.simulation.fmu.description import Description, FmuError, FmuVariable, read_description
from mkc_torch.simulation.fmu.evaluation import Evaluation, EvaluationPoints
from mkc_torch.simulation.fmu.function import evaluated
from mkc_torch.simulation.parameter import SimulationError

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["FmuDynamics", "fmu_class", "is_of_an_fmu", "load_fmu"]

_PROBES = 7


class FmuDynamics(Dynamics):
    """The equations of an FMU; :func:`fmu_class` makes a class of one, with its names, parameters and units.

    All real parameters that are fixed or tunable are fitted, within min and max. A state that an output of the FMU is
    the value of has that output's name. A recording may call its columns as the FMU does, "body.phi", or by names that
    can be attributes, "body_phi". What is compared are those outputs and states that are its columns.

    Effects act beside the FMU: on the rates that it gives, on the inputs that it is given and on its outputs.

    Attributes:
        evaluation: of the FMU.
        of_states: names of the FMU's own states; a class derived from this one may have more.
        shown: outputs that are no states, by their place among the FMU's outputs.
        labels: what the FMU itself calls states, inputs and outputs.
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
        asked = [name for name in self.shown if not self.outputs or name in self.outputs]
        if asked:
            values = self._evaluated(True, time, x, u, p)
            found |= {name: values[..., self.shown[name]] for name in asked}
        return found

    def prepare(self, recording: Recording) -> PreparedDynamics:
        """The simulation of a recording.

        Raises:
            MissingColumnError: the recording lacks ``time`` or an input.
            SimulationError: none of the outputs is a column of it.
        """
        recording = self._renamed(recording)
        known = (*self.shown, *self.of_states)
        measured = self.outputs or tuple(name for name in known if name in recording)
        if not measured:
            labels = ", ".join(dict.fromkeys(self.labels.get(name, name) for name in known))
            raise SimulationError(
                f"{self.name}: none of the FMU's outputs and states is a column of the recording. It has {labels}; the "
                f"recording has {', '.join(recording.names)}. Say which column is which, --columns NAME=COLUMN."
            )
        own = type(self)()
        own.__dict__.update(self.__dict__)
        own.outputs = measured
        return PreparedDynamics(own, recording.finite("time", *own.inputs, *measured).sorted_by_time(), measured)

    def __reduce__(self) -> Any:
        if is_of_an_fmu(type(self)):  # such a class has no name by which it could be imported
            return load_fmu, (str(self.evaluation.description.path),)
        return object.__reduce__(self)

    def _renamed(self, recording: Recording) -> Recording:
        """Columns that are called as the FMU calls them, by names that can be attributes."""
        new = {label: name for name, label in self.labels.items() if label in recording and name not in recording}
        if not new:
            return recording
        return Recording(
            {new.get(name, name): values for name, values in recording.columns.items()},
            name=recording.name,
            units={new.get(name, name): unit for name, unit in recording.units.items()},
            warnings=recording.warnings,
            labels={new.get(name, name): label for name, label in recording.labels.items()},
        )

    def _evaluated(self, outputs: bool, time: Tensor, x: Any, u: Any, p: Any) -> Tensor:
        states = torch.stack(torch.broadcast_tensors(*(getattr(x, name) for name in self.of_states)), -1)
        rows = states.shape[0]
        inputs = states.new_zeros(rows, 0)
        if self.inputs:
            inputs = torch.stack([getattr(u, name).expand(rows) for name in self.inputs], -1)
        known = [getattr(p, one.name) for one in self.evaluation.description.parameters]
        parameters = torch.stack(known) if known else states.new_zeros(0)
        return evaluated(self.evaluation, outputs, time.expand(rows), states, inputs, parameters)


def load_fmu(path: str | Path) -> FmuDynamics | Simulated:
    """The simulation that is in an FMU, whose binary is run.

    One for co-simulation alone brings its own solver: what it simulates is compared as the output of a simulator.

    Raises:
        FmuError: it cannot be used.
        ImportError: FMPy is not installed.
    """
    described = read_description(Path(path))
    return _class_of(described)() if described.exchange else Simulated(described)


def fmu_class(path: str | Path, file: str | None = None) -> type[FmuDynamics]:
    """A class of the equations in an FMU, to derive from as from :class:`mkc_torch.simulation.Dynamics`.

    Args:
        path: of the FMU.
        file: ``__file__`` of the one that asks, from whose folder the path goes; None for the folder of the call.

    Raises:
        FmuError: it cannot be used, or is for co-simulation alone.
        ImportError: FMPy is not installed.
    """
    place = Path(path)
    if file is not None:
        folder = Path(file).resolve().parent
        places = [folder / path, folder / place.name, Path.cwd() / place.name]
        place = next((one for one in places if one.is_file()), places[0])
    described = read_description(place)
    if not described.exchange:
        raise FmuError(f"{place}: this FMU is for co-simulation alone; export it for model exchange.")
    return _class_of(described)


def is_of_an_fmu(kind: type) -> TypeGuard[type[FmuDynamics]]:
    """Whether a class is that of an FMU, as :func:`fmu_class` makes it, and not one derived from it.

    Example:
        >>> is_of_an_fmu(dict)
        False
    """
    return issubclass(kind, FmuDynamics) and "evaluation" in vars(kind)


def _class_of(described: Description) -> type[FmuDynamics]:
    evaluation = Evaluation(described)
    if not evaluation.binary.begin([one.value for one in described.parameters.values()]):
        said = "; ".join(evaluation.binary.messages)
        raise FmuError(
            f"{described.path}: the FMU cannot be initialised with its own start values{f' ({said})' if said else ''}."
        )
    first = evaluation.binary.first_states()
    _refuse_memory(evaluation, first)
    evaluation.binary.timed = not (described.timeless and _is_timeless(evaluation, first))
    names = _names_of_states(evaluation, first)
    shown = {one.name: k for k, one in enumerate(described.outputs) if one.name not in names.values()}
    states = tuple(names.values())
    quantities = [*described.inputs, *described.outputs]
    labels = {one.name: one.label for one in quantities}
    labels |= {names[one]: one.label for one in described.states if names[one] not in labels}
    own = zip(described.states, states, strict=True)
    units = {one.name: one.unit for one in quantities if one.unit} | {name: one.unit for one, name in own if one.unit}
    body = {
        "__doc__": f"The equations of {described.path.name}.",
        "evaluation": evaluation,
        "of_states": states,
        "shown": shown,
        "labels": labels,
        "states": states,
        "inputs": tuple(one.name for one in described.inputs),
        "parameters": {one.name: parameter for one, parameter in described.parameters.items()},
        "units": units,
        "initial": dict(zip(states, first.tolist(), strict=True)),
    }
    return type(described.name, (FmuDynamics,), body)


def _probes(evaluation: Evaluation, first: NDArray[np.float64]) -> EvaluationPoints:
    """A few moments about where the FMU starts; the same ones each time."""
    described = evaluation.description
    scattered = np.random.default_rng(0).uniform(0.1, 1.0, (_PROBES, len(first) + len(described.inputs)))
    n = len(first)
    states = first * (1.0 + 0.1 * scattered[:, :n]) + np.where(first == 0.0, scattered[:, :n], 0.0)
    values = np.array([one.value for one in described.parameters.values()])
    return EvaluationPoints(np.arange(_PROBES, dtype=np.float64), states, scattered[:, n:], values)


def _is_timeless(evaluation: Evaluation, first: NDArray[np.float64]) -> bool:
    """Whether another time changes nothing: one that need not be set is set a third of the calls less."""
    if evaluation.description.events:
        return False
    time, states, inputs, parameters = _probes(evaluation, first).parts
    for outputs in (False, True):
        one, other = (
            evaluation.values(outputs, EvaluationPoints(time + more, states, inputs, parameters)) for more in (0, 0.7)
        )
        if not np.array_equal(one, other, equal_nan=True):
            return False
    return True


def _names_of_states(evaluation: Evaluation, first: NDArray[np.float64]) -> dict[FmuVariable, str]:
    """Names of the states: that of an output which is nothing but the state, else its own."""
    described = evaluation.description
    names = {one: one.name for one in described.states}
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
    """Refuses an FMU whose rates depend on what it was asked before: a state of its own that events change."""
    if not evaluation.description.events:
        return
    at = _probes(evaluation, first)
    time, states, inputs, parameters = at.parts
    plain = evaluation.values(False, at)
    back = evaluation.values(False, EvaluationPoints(time[::-1], states[::-1], inputs[::-1], parameters))[::-1]
    if not np.array_equal(plain, back, equal_nan=True):
        raise FmuError(
            f"{evaluation.description.path}: the FMU's rates depend on events before, as of a hysteresis or a clock, "
            "which a diagnosis cannot follow: let its tool simulate the recording, and give what it wrote with "
            "`--simulator-output SIM.csv`."
        )
