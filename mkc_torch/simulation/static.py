"""Simulations without states: outputs as a function of inputs and parameters, sample by sample."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from mkc_torch._support.arguments import refuse_other_type, refuse_text
from mkc_torch._support.dual_constants import dual_constants
from mkc_torch.nonlinear import load_forward_mode
from mkc_torch.recording.join_recordings import Clock, refuse_no_recording
from mkc_torch.recording.recording import Recording
from mkc_torch.simulation.names import Names
from mkc_torch.simulation.outputs import changed_outputs, output_ports, output_signals
from mkc_torch.simulation.own_offsets import OwnOffset, determined_offsets
from mkc_torch.simulation.parameter import Parameter, SimulationError, known_parameters
from mkc_torch.simulation.ports import Changes, Nearby, Port, SignalSizes
from mkc_torch.simulation.protocol import ClosedForm
from mkc_torch.simulation.start_checks import Sensitivity, bound_checks, moved_inside, parameter_checks
from mkc_torch.simulation.undetermined import undetermined

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

MOST_PARAMETERS = 200
"""Largest number of parameters of a module; a larger module can fit anything, and so lacks no effect."""


class Static:
    """Outputs as a function of inputs and parameters at the same moment: derive from it, or wrap a module.

    A subclass defines names, parameters and ``output``. A module takes the stacked inputs, (N, k), and returns the
    outputs, (N, m), or (N,) for a single output; all its parameters are fitted, starting from their values. The module
    is copied, and evaluated in float64 and in evaluation mode.

    Args:
        module: a module; None for a subclass with ``output``.
        inputs, outputs: names of columns; default the class attributes.
        name: name of the simulation; default the name of the class, or of the module's class.

    Attributes:
        inputs: names of the input columns.
        outputs: names of the predicted columns.
        parameters: name to start value or :class:`mkc_torch.simulation.Parameter`.
        units: units of inputs and outputs.
        joins_experiments: False: each run of a recording is diagnosed separately.

    Raises:
        TypeError: ``module`` is not a module, or names of columns are a string.
        SimulationError: a module without parameters that are real numbers, or with more than 200 of them.

    Example:
        >>> class Thermistor(Static):
        ...     inputs = ("temperature",)
        ...     outputs = ("voltage",)
        ...     parameters = {"bottom": 0.3, "slope": Parameter(0.01, lower=0.0, unit="V/K")}
        ...
        ...     def output(self, time, u, p):
        ...         return {"voltage": p.bottom + p.slope * u.temperature}
        >>> time = torch.arange(0.0, 10.0, 0.1)
        >>> recording = Recording({"time": time, "temperature": 20.0 + time, "voltage": 0.5 + 0.01 * time})
        >>> Thermistor().prepare(recording).parameter_names
        ('bottom', 'slope')
        >>> line = Static(torch.nn.Linear(1, 1), inputs=("temperature",), outputs=("voltage",))
        >>> line.name, line.prepare(recording).parameter_names
        ('Linear', ('weight[0,0]', 'bias[0]'))
    """

    inputs: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()
    parameters: Mapping[str, float | Parameter] = {}
    units: Mapping[str, str] = {}
    joins_experiments: bool = False

    def __init__(
        self,
        module: nn.Module | None = None,
        *,
        inputs: Sequence[str] | None = None,
        outputs: Sequence[str] | None = None,
        name: str | None = None,
    ) -> None:
        for what, names in (("inputs", inputs), ("outputs", outputs)):
            chosen = getattr(self, what) if names is None else names
            refuse_text(what, chosen, "a tuple of names of columns")
            setattr(self, what, tuple(chosen))
        if module is not None:
            advice = "derive from Static, with an `output`, for a function"
            refuse_other_type("module", module, nn.Module, "a torch.nn.Module", advice)
        if name is not None:
            refuse_other_type("name", name, str, "text", "write 'line' say")
        self.module = None if module is None else copy.deepcopy(module).double().eval()
        self._name = name or (type(self).__name__ if module is None else type(module).__name__)
        if self.module is not None:
            self.parameters = _numbers_of(self.module, self._name)

    @property
    def name(self) -> str:
        return self._name

    @property
    def columns(self) -> frozenset[str]:
        return frozenset({"time", "experiment", *self.inputs, *self.outputs})

    @property
    def measured(self) -> frozenset[str]:
        return frozenset(self.outputs)

    @property
    def joint_clock(self) -> Clock:
        return "restart" if self.joins_experiments else "follow"

    def output(self, time: Tensor, u: Any, p: Any) -> Mapping[str, Tensor]:
        """The predicted outputs: name of the column to (N,).

        Args:
            time: (N,), in s.
            u: the inputs as attributes, each (N,).
            p: the parameters as attributes.
        """
        raise NotImplementedError(
            f"{type(self).__name__} has no `output(self, time, u, p)`; write one that returns each of its outputs, or "
            "wrap a module: Static(module, inputs=(...), outputs=(...))."
        )

    def computed(
        self, time: Float[Tensor, " N"], inputs: Float[Tensor, "N k"], theta: Float[Tensor, " p"]
    ) -> Float[Tensor, "N m"]:
        """The stacked outputs.

        Raises:
            SimulationError: an output has a wrong shape or is missing.
        """
        if self.module is not None:
            known = dict(self.module.named_parameters())
            parts = theta.split([tensor.numel() for tensor in known.values()])
            values = {name: part.reshape(known[name].shape) for name, part in zip(known, parts, strict=True)}
            try:
                found = torch.func.functional_call(self.module, values, (inputs,))
            except RuntimeError as error:
                raise SimulationError(
                    f"{self.name}: the module fails on inputs of shape {tuple(inputs.shape)}, a column for each of "
                    f"{', '.join(self.inputs) or 'no inputs'}: {error}"
                ) from error
            return self._checked_module(found, len(time))
        u = Names(**dict(zip(self.inputs, inputs.unbind(-1), strict=True)))
        p = Names(**dict(zip(self.parameters, theta.unbind(), strict=True)))
        outputs = self.output(time, u, p)
        return torch.stack([self._checked(outputs, name, len(time)) for name in self.outputs], -1)

    def _checked_module(self, found: object, count: int) -> Tensor:
        m = len(self.outputs)
        if isinstance(found, Tensor) and found.shape == (count,) and m == 1:
            return found.unsqueeze(-1)
        if not isinstance(found, Tensor) or found.shape != (count, m):
            returned = tuple(found.shape) if isinstance(found, Tensor) else type(found).__name__
            raise SimulationError(
                f"{self.name}: the module should return a tensor of shape ({count}, {m}), a column for each of "
                f"{', '.join(self.outputs)}, but it returns {returned}."
            )
        return found

    def _checked(self, outputs: Mapping[str, Tensor], name: str, count: int) -> Tensor:
        if not isinstance(outputs, Mapping) or name not in outputs:
            returned = ", ".join(map(str, outputs)) if isinstance(outputs, Mapping) else type(outputs).__name__
            raise SimulationError(
                f"{self.name}.output does not return `{name}`, which is in its outputs; it returns {returned}."
            )
        value = outputs[name]
        if not isinstance(value, Tensor) or value.shape not in ((), (1,), (count,)):
            actual = str(tuple(value.shape)) if isinstance(value, Tensor) else type(value).__name__
            raise SimulationError(
                f"{self.name}.output: `{name}` should be a tensor of shape ({count},), like the inputs it is given, "
                f"but is {actual}."
            )
        return value.expand(count)

    def prepare(self, recording: Recording) -> PreparedStatic:
        """The simulation together with a recording, which needs no ``time``.

        Raises:
            TypeError: ``recording`` is not a recording.
            MissingColumnError: the recording lacks an input or an output.
            SimulationError: outputs are missing, a name is repeated, a parameter is not a number, a module takes
                another number of inputs, or ``output`` returns a wrong shape or values that are not finite.
        """
        refuse_no_recording("recording", recording)
        twice = sorted({name for names in (self.inputs, self.outputs) for name in names if names.count(name) > 1})
        if twice:
            raise SimulationError(f"{self.name} names the column `{twice[0]}` twice; name it once.")
        if not self.outputs:
            raise SimulationError(f"{self.name} has no `outputs`; name the columns that it predicts.")
        table = recording.finite(*self.inputs, *self.outputs)
        return PreparedStatic(self, table if table.time is None else table.sorted_by_time())

    def correction(self, state: Mapping[str, Any], recording: Recording) -> StaticCorrection:
        """The simulation with known parameters on a new recording; see :class:`mkc_torch.simulation.Correction`."""
        return StaticCorrection(self, state.get("fixed", ()), state.get("unscaled", ()), recording)


class PreparedStatic(ClosedForm):
    """A function of inputs together with a recording."""

    def __init__(
        self,
        system: Static,
        recording: Recording,
        own_offsets: tuple[OwnOffset, ...] = (),
        of_recording: Int[Tensor, " N"] | None = None,
    ) -> None:
        self.system, self.recording = system, recording
        self.own_offsets, self._of_recording = own_offsets, of_recording
        self.name, self.channels = system.name, system.outputs
        self.time = torch.arange(len(recording)).double() if recording.time is None else recording.time
        self.inputs = _inputs(system, recording)
        self.measured = recording.stack(*system.outputs)
        units = {name: system.units.get(name, recording.units[name]) for name in (*system.inputs, *system.outputs)}
        own = {units[name] for name in system.outputs}
        self.unit = own.pop() if len(own) == 1 else ""
        self.known = known_parameters(system.name, system.parameters)
        self.known |= {offset.name: Parameter(0.0, unit=units[offset.output]) for offset in own_offsets}
        self.parameter_names = tuple(self.known)
        low = [parameter.lower for parameter in self.known.values()]
        high = [parameter.upper for parameter in self.known.values()]
        self.bounds = self.time.new_tensor(low), self.time.new_tensor(high)
        self.independent = (True,) * len(self.channels)
        self._start = [parameter.value for parameter in self.known.values()]
        self._refuse_not_finite()
        load_forward_mode()
        given = list(self.known.values())
        moved = moved_inside(given, lambda: self._sensitivity(self.start()))
        self._start = [moved.get(number, parameter.value) for number, parameter in enumerate(given)]
        at = self._sensitivity(self.start())
        tangents = at.tangents
        self.warnings = undetermined(tangents.flatten(0, 1), self.start(), self.parameter_names)
        names = list(self.parameter_names[: len(self.known) - len(own_offsets)])
        checks = parameter_checks(at, names, lambda theta: self.residual(theta, {}), self._uses)
        self.checks = (*checks, *bound_checks(self.parameter_names, given, moved))
        outputs = self._outputs(self.start(), {})
        constants = torch.ones_like(outputs)
        fixed, unscaled = (
            [name for k, name in enumerate(self.channels) if not _can_add(tangents, k, added[:, k])]
            for added in (constants, outputs)
        )
        self.state: Mapping[str, object] = {"class": system.name, "fixed": fixed, "unscaled": unscaled}
        self.ports = static_ports(system, units, self.unit, self.inputs, self.measured, fixed, unscaled)

    def start(self, rows: Bool[Tensor, " N"] | None = None) -> Float[Tensor, " p"]:
        return self.time.new_tensor(self._start)

    def _sensitivity(self, theta: Float[Tensor, " p"]) -> Sensitivity:
        tangents = torch.func.jacfwd(dual_constants(lambda values: self.residual(values, {})))(theta)
        return Sensitivity(theta, torch.where(theta == 0, 1.0, theta.abs()), tangents, self.measured.std(0))

    def _uses(self, number: int) -> bool:
        """Whether an output depends on a parameter at these inputs, or at inputs of twice the size."""
        other = self.start()
        other[number] = 1.7 * other[number] + 0.1
        own = len(other) - len(self.own_offsets)
        for inputs in (self.inputs, 2.0 * self.inputs + 1.0):
            outputs = [self.system.computed(self.time, inputs, theta[:own]) for theta in (self.start(), other)]
            if not torch.equal(*outputs):
                return True
        return False

    def residual(self, theta: Float[Tensor, " p"], changes: Changes) -> Float[Tensor, "N m"]:
        return self.measured - changed_outputs(self._outputs(theta, changes), self.channels, changes)

    def signals(
        self, theta: Float[Tensor, " p"], changes: Changes, near: Nearby | None = None
    ) -> Mapping[str, Float[Tensor, "N k"]]:
        inputs = {f"input {name}": self.inputs[:, [k]] for k, name in enumerate(self.system.inputs)}
        return inputs | output_signals(self._outputs(theta, changes), self.channels, changes)

    def _outputs(self, theta: Tensor, changes: Changes) -> Tensor:
        inputs, own = _changed_inputs(self.system, self.inputs, changes), len(theta) - len(self.own_offsets)
        outputs = self.system.computed(self.time, inputs, theta[:own])
        return outputs if self._of_recording is None else outputs + self._offsets(theta[own:], self._of_recording)

    def _offsets(self, values: Float[Tensor, " q"], recording: Int[Tensor, " N"]) -> Float[Tensor, "N m"]:
        """The offset of each output at each sample, (N, m), by the recording of the sample."""
        added = [torch.zeros_like(self.time) for _ in self.channels]
        for offset, value in zip(self.own_offsets, values.unbind(), strict=True):
            column = self.channels.index(offset.output)
            added[column] = added[column] + value * (recording == offset.recording).to(self.time.dtype)
        return torch.stack(added, -1)

    def with_own_offsets(self, recording: Int[Tensor, " N"], names: Sequence[str]) -> PreparedStatic:
        """The simulation with an offset of each output in each recording, where it is identifiable.

        Args:
            recording: number of each sample's recording.
            names: names of the recordings.
        """
        tangents = torch.func.jacfwd(dual_constants(lambda theta: self.residual(theta, {})))(self.start())
        found = determined_offsets(tangents, self.channels, recording, names)
        return PreparedStatic(self.system, self.recording, found, recording) if found else self

    def _refuse_not_finite(self) -> None:
        outputs = self._outputs(self.start(), {})
        bad = (~outputs.isfinite()).nonzero()
        if not len(bad):
            return
        row, column = bad[0].tolist()
        inputs = [f"{name} = {float(self.inputs[row, k]):.4g}" for k, name in enumerate(self.system.inputs)]
        parameters = [f"{name} = {known.value:.4g}" for name, known in list(self.known.items())[:12]]
        raise SimulationError(
            f"{self.name}.output: `{self.channels[column]}` is {float(outputs[row, column])} at time "
            f"{float(self.time[row]):.4g} s with {', '.join(inputs) or 'no inputs'}; parameters "
            f"{', '.join(parameters) or 'none'}. Keep it finite there, or start from other parameters."
        )


class StaticCorrection:
    """A function of inputs with known parameters and effects on a new recording, which needs no outputs.

    Args:
        system: the function.
        fixed: outputs that no parameter of the function shifts.
        unscaled: outputs that no parameter of the function scales.
        recording: a recording of the inputs.

    Raises:
        MissingColumnError: an input is missing.
    """

    def __init__(self, system: Static, fixed: Sequence[str], unscaled: Sequence[str], recording: Recording) -> None:
        self.system, self.recording = system, recording
        self.time = torch.arange(len(recording)).double() if recording.time is None else recording.time
        self.inputs = _inputs(system, recording)
        units = {name: system.units.get(name, "") for name in (*system.inputs, *system.outputs)}
        nothing = self.time.new_zeros(len(self.time), len(system.outputs))
        self.ports = static_ports(system, units, "", self.inputs, nothing, fixed, unscaled)

    def corrected(self, theta: Float[Tensor, " p"], changes: Changes) -> dict[str, Float[Tensor, " N"]]:
        """The simulated outputs with the effects."""
        inputs = _changed_inputs(self.system, self.inputs, changes)
        outputs = changed_outputs(self.system.computed(self.time, inputs, theta), self.system.outputs, changes)
        return {"time": self.time} | dict(zip(self.system.outputs, outputs.unbind(-1), strict=True))


def _inputs(system: Static, recording: Recording) -> Float[Tensor, "N k"]:
    if not system.inputs:
        return torch.zeros(len(recording), 0, dtype=torch.float64)
    return recording.stack(*system.inputs)


def _changed_inputs(system: Static, inputs: Float[Tensor, "N k"], changes: Changes) -> Float[Tensor, "N k"]:
    columns = [
        inputs[:, [k]] + changes[f"input {name}"](inputs[:, [k]]) if f"input {name}" in changes else inputs[:, [k]]
        for k, name in enumerate(system.inputs)
    ]
    return torch.cat(columns, -1) if columns else inputs


def static_ports(
    system: Static,
    units: Mapping[str, str],
    unit: str,
    inputs: Float[Tensor, "N k"],
    measured: Float[Tensor, "N m"],
    fixed: Sequence[str],
    unscaled: Sequence[str],
) -> dict[str, Port]:
    """Return the ports at the inputs and outputs of a function.

    Args:
        system: the function.
        units: unit of each input and output.
        unit: common unit of the outputs; empty where the units differ.
        inputs: (N, k), the recorded inputs, for the sizes of the signals.
        measured: (N, m), the recorded outputs, likewise.
        fixed: outputs that no parameter shifts.
        unscaled: outputs that no parameter scales.
    """
    ports = {}
    for k, name in enumerate(system.inputs):
        ports[f"input {name}"] = Port(
            (name,),
            units[name],
            kind="input",
            parts={"own": name},
            part_units={"own": units[name]},
            sizes={"own": SignalSizes.of(inputs[:, k])},
        )
    return ports | output_ports(system.outputs, units, unit, measured, fixed, unscaled)


def _can_add(tangents: Float[Tensor, "N m p"], channel: int, added: Float[Tensor, " N"]) -> bool:
    """Whether a change of the parameters can add these values to one output and leave the others unchanged."""
    change = torch.zeros_like(tangents[..., :1])
    change[:, channel, 0] = added
    columns, target = tangents.flatten(0, 1), change.flatten(0, 1)
    columns = columns / torch.linalg.vector_norm(columns, dim=0).clamp(min=1e-300)
    solution = torch.linalg.lstsq(columns, target, driver="gelsd").solution
    remainder = torch.linalg.vector_norm(target - columns @ solution)
    return bool(remainder <= 1e-6 * torch.linalg.vector_norm(target))


def _numbers_of(module: nn.Module, name: str) -> dict[str, float]:
    """Each number of a module's parameters: name with index to value."""
    numbers: dict[str, float] = {}
    for key, values in module.named_parameters():
        if not values.is_floating_point():
            raise SimulationError(f"{name}: its parameter `{key}` holds {values.dtype} instead of real numbers.")
        flat = values.detach().flatten().tolist()
        for place, value in enumerate(flat):
            index = torch.unravel_index(torch.tensor(place), values.shape) if values.dim() else ()
            label = ",".join(str(int(i)) for i in index)
            numbers[f"{key}[{label}]" if label else key] = value
    if not numbers:
        raise SimulationError(
            f"{name}: the module has no parameters; register at least one number as nn.Parameter, to be fitted."
        )
    if len(numbers) > MOST_PARAMETERS:
        raise SimulationError(
            f"{name}: the module has {len(numbers):,} numbers, more than {MOST_PARAMETERS}; a network that can follow "
            "any recording leaves no physics to find. Freeze it into a function of few parameters, and write that as "
            "`output`."
        )
    return numbers
