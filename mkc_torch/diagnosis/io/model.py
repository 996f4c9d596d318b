"""Simulation with findings: a module, its file model.json, and the correction of new recordings."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from mkc_torch._support.initial_values import InitialParameters
from mkc_torch.diagnosis.declared import checked_input_hold
from mkc_torch.diagnosis.io.mjcf import Part, mjcf_changes, mjcf_source
from mkc_torch.diagnosis.io.python_source import SourceError, python_source
from mkc_torch.diagnosis.io.selected_sizes import refuse_unselected, selected, without_runs
from mkc_torch.diagnosis.io.term_entry import term_entry
from mkc_torch.diagnosis.io.training import Training
from mkc_torch.diagnosis.model.fit import FittedModel
from mkc_torch.diagnosis.model.joint import in_order_of_the_chain, summed
from mkc_torch.diagnosis.model.term import Driver, Term, context_at
from mkc_torch.diagnosis.result import CorrectingModel
from mkc_torch.effects import CATALOGUE
from mkc_torch.effects.base import Effect
from mkc_torch.effects.context import Context
from mkc_torch.effects.per_recording import PerRecording
from mkc_torch.effects.sensor.unrecorded import COURSE, Unrecorded
from mkc_torch.recording.recording import MissingColumnError, Recording
from mkc_torch.simulation.dynamics import Dynamics
from mkc_torch.simulation.magnetometer import Magnetometer
from mkc_torch.simulation.paired import Paired
from mkc_torch.simulation.ports import Change, Changes
from mkc_torch.simulation.protocol import CorrectableSimulation, Correction, PreparedSimulation, Simulation
from mkc_torch.simulation.stepped.mujoco import MujocoStepper

if TYPE_CHECKING:
    from jaxtyping import Float

SCHEMA = "mkc-model/1"


class ModelFileError(ValueError):
    """Text that is not a valid model.json."""


class DiagnosedModel(CorrectingModel):
    """Simulation with the findings of a diagnosis, for other recordings of the same sensor or system.

    Args:
        simulation: its name.
        state: constants that the simulation needs to correct a recording.
        parameters: the simulation's own, (p,).
        terms: the effects, each with its driver's columns, their reference and units, and its shape.
        gammas: their γ.
        source: the user's simulation, which files do not contain.
        reference: the recordings that the model was fitted to, and the simulation without findings; None if unknown.

    Attributes:
        theta: the simulation's parameters.
        gammas: a parameter list, one γ per effect.

    Example:
        >>> from mkc_torch import diagnose
        >>> from mkc_torch.recording.demonstration import simulated_recording
        >>> from mkc_torch.simulation import Magnetometer
        >>> recording, _ = simulated_recording()
        >>> model = diagnose(Magnetometer(), recording).model
        >>> columns, left_out = DiagnosedModel.from_json(model.to_json()).correct(recording)
        >>> list(columns)
        ['time', 'field_x', 'field_y', 'field_z']
    """

    def __init__(
        self,
        simulation: str,
        state: Mapping[str, Any],
        parameters: Float[Tensor, " p"],
        terms: Sequence[Term],
        gammas: Sequence[Float[Tensor, " q"]],
        source: Simulation | None = None,
        reference: Training | None = None,
    ) -> None:
        super().__init__()
        self.simulation = simulation
        self.state = dict(state)
        self._register("theta", parameters, learned=False)
        self.gammas = InitialParameters(gammas)
        self.terms = tuple(terms)
        self.source = source
        self.reference = reference

    @property
    def baseline(self) -> DiagnosedModel:
        """The simulation without the findings, with the parameters of its own fit to the diagnosed recording.

        Raises:
            ValueError: these parameters are not known, because the file is of an earlier version.
        """
        known = self.reference
        if known is None:
            raise ValueError(
                "the model does not hold the simulation without findings, which a check compares it with; diagnose the "
                "recording again with this version."
            )
        theta = torch.tensor(known.parameters, dtype=torch.float64)
        return DiagnosedModel(self.simulation, known.state, theta, (), (), self.source)

    def with_input_hold(self, hold: Mapping[str, str]) -> DiagnosedModel:
        """Return the model with other holds of its inputs, for a recording of another logger.

        Args:
            hold: "held", "linear" or "smooth", by input.

        Raises:
            ValueError: an input that the simulation does not have, or an unknown hold.
        """
        known = dict(self.state.get("input_hold", {}))
        state = {**self.state, "input_hold": {**known, **checked_input_hold(hold, tuple(known))}}
        return self._with(self.terms, list(self.gammas), state)

    def with_sizes_of(self, recording: str) -> DiagnosedModel:
        """Return the model with the sizes of one of the diagnosed recordings, where sizes differ between them.

        Args:
            recording: its name.

        Raises:
            ValueError: no size differs, or the recording is not one of them.
        """
        return self._with(*selected(self.terms, list(self.gammas), recording))

    def for_other_recordings(self) -> DiagnosedModel:
        """Return the model without the assignment of runs to the diagnosed recordings."""
        return self._with(without_runs(self.terms), list(self.gammas))

    def _with(
        self, terms: Sequence[Term], gammas: Sequence[Tensor], state: Mapping[str, Any] | None = None
    ) -> DiagnosedModel:
        state = self.state if state is None else state
        return DiagnosedModel(self.simulation, state, self.theta, terms, gammas, self.source, self.reference)

    def correct(self, recording: Recording) -> tuple[dict[str, Float[Tensor, " N"]], tuple[str, ...]]:
        """Return the corrected signal of a recording (N,), and notes on effects that do not transfer.

        Of an effect that depends on the time of the diagnosed recording, its final value is subtracted, such as the
        offset after the last step; an effect that depends on its location is omitted.

        Raises:
            MissingColumnError: a column of the simulation, or an effect's driver, is missing.
            ValueError: a size differs between the diagnosed recordings, and none is selected by :meth:`with_sizes_of`.
        """
        correction = correction_of(self.simulation, self.state, recording, self.source)
        changes, notes = self.changes(correction)
        return correction.corrected(self.theta, changes), notes

    def changes(self, correction: Correction) -> tuple[Changes, tuple[str, ...]]:
        """Return the change by the effects at each port, and notes on effects that do not transfer.

        Args:
            correction: the simulation on a recording, which has the columns that drive the effects.

        Raises:
            MissingColumnError: an effect's driver is missing.
            ValueError: a size differs between the diagnosed recordings, and none is selected.
        """
        refuse_unselected(self.terms)
        changes: dict[str, Change] = {}
        notes = []
        for number in in_order_of_the_chain(self.terms, range(len(self.terms))):
            term, gamma = self.terms[number], self.gammas[number]
            port = term.port
            if port not in correction.ports:
                notes.append(f"{term.effect.id} depends on the location of the diagnosed recording and is left out.")
                continue
            series = correction.ports[port].in_series(port)
            change = self._change(term, gamma, correction)
            changes[port] = summed(changes.get(port), change, series=series)
            if term.effect.persistent_change:
                notes.append(
                    f"{term.effect.id} depends on the time of the diagnosed recording: its final change applies to "
                    "all samples."
                )
        return changes, tuple(notes)

    def forward(self, recording: Recording) -> dict[str, Float[Tensor, " N"]]:
        """Return the corrected signal, see :meth:`correct`."""
        return self.correct(recording)[0]

    def _change(self, term: Term, gamma: Tensor, correction: Correction) -> Change:
        effect, shape = term.effect, term.shape
        bare = _context(term, correction)

        def change(signal: Tensor) -> Tensor:
            context = replace(bare, signal=signal)
            return effect.lasting(gamma, context) if effect.persistent_change else effect.change(gamma, shape, context)

        return change

    def to_json(self) -> str:
        """Return the model as JSON of the schema "mkc-model/1"; numbers round-trip exactly."""
        terms = [term_entry(term, gamma) for term, gamma in zip(self.terms, self.gammas, strict=True)]
        content = {
            "schema": SCHEMA,
            "simulation": self.simulation,
            "state": self.state,
            "parameters": self.theta.tolist(),
            "effects": terms,
            **({} if self.reference is None else {"training": self.reference.to_dict()}),
        }
        return json.dumps(content, indent=2, ensure_ascii=False, allow_nan=False) + "\n"

    def to_python(self, module: str | None = None, folder: Path | None = None) -> str:
        """Return Python source of a class derived from the diagnosed class, with the findings.

        Its parameters have the fitted values, and each effect is a line of torch. It is a
        :class:`mkc_torch.simulation.Dynamics` without the initial states of the recording. Numbers have nine digits.

        Args:
            module: to import the diagnosed class from; default its defining module.
            folder: of the written file: a class that was loaded from a file is loaded by its path relative to it.

        Raises:
            SourceError: the simulation has no differential equations, or an effect has no source code.
        """
        system = self.source
        if not isinstance(system, Dynamics):
            raise SourceError(
                f'Only differential equations can be exported as Python, but the model is of "{self.simulation}"'
                f"{'' if system else '; give its simulation with `simulation=`'}."
            )
        measured = tuple(map(str, self.state.get("outputs", system.outputs or system.states)))
        holds = self.state.get("input_hold", {})
        return python_source(
            system, self.theta.tolist(), self.terms, tuple(self.gammas), measured, holds, module, folder
        )

    def to_mjcf(self) -> tuple[str, tuple[str, ...]]:
        """Return a MuJoCo model's file with the fitted numbers and findings, and the findings that it cannot express.

        Raises:
            SourceError: the simulation is no MuJoCo model; also in the two methods that follow.
        """
        return mjcf_source([self.mjcf_part()])

    def mjcf_changes(self) -> str:
        """Return what :meth:`to_mjcf` changes in a MuJoCo model's file, as a unified diff."""
        return mjcf_changes(self.mjcf_part()[0], self.to_mjcf()[0])

    def mjcf_part(self) -> Part:
        """Return what a MuJoCo model's file is written from."""
        if not isinstance(self.source, MujocoStepper):
            raise SourceError(f'Only a MuJoCo model can be exported as MJCF, but the model is of "{self.simulation}".')
        return self.source, self.theta.tolist(), self.terms, tuple(self.gammas)

    @staticmethod
    def from_json(
        text: str, effects: Sequence[Effect] = CATALOGUE, simulation: Simulation | None = None
    ) -> DiagnosedModel:
        """Read a model from JSON.

        Args:
            text: of model.json.
            effects: catalogue in which effects are looked up by id; add the user's effects.
            simulation: the diagnosed simulation of the user; None for a simulation of the package.

        Raises:
            ModelFileError: not JSON, another schema, an unknown effect, or a value of the wrong type.

        Example:
            >>> DiagnosedModel.from_json("{}")
            Traceback (most recent call last):
            mkc_torch.diagnosis.io.model.ModelFileError: this is no model: its schema is missing ...
        """
        try:
            content = json.loads(text)
        except json.JSONDecodeError as error:
            raise ModelFileError(f"this is no model: it is not JSON ({error}).") from None
        schema = content.get("schema") if isinstance(content, dict) else None
        if schema != SCHEMA:
            found = "missing" if schema is None else json.dumps(schema)
            raise ModelFileError(f'this is no model: its schema is {found} and not "{SCHEMA}".')
        try:
            return _read(content, effects, simulation)
        except (KeyError, TypeError, ValueError) as error:
            if isinstance(error, ModelFileError):
                raise
            raise ModelFileError(f"this model is damaged: {type(error).__name__} {error}.") from None


def model_of(fit: FittedModel, simulation: Simulation) -> DiagnosedModel:
    """Return the model of a fit."""
    model = fit.model
    signals = model.signals(fit.parameters)
    terms = []
    for term in model.terms:
        context = term.context(model.prepared, signals.get(term.port))
        terms.append(replace(term, shape=term.effect.bind(term.shape, context)))
    parameters = fit.parameters
    return DiagnosedModel(
        model.prepared.name,
        model.prepared.state,
        own_parameters(model.prepared, parameters),
        terms,
        model.gammas(parameters),
        simulation,
    )


def own_parameters(prepared: PreparedSimulation, parameters: Float[Tensor, " p"]) -> Float[Tensor, " q"]:
    """Return the simulation's parameters and initial states, without the offsets of single recordings."""
    of_recordings = {offset.name for offset in prepared.own_offsets}
    return parameters[[k for k, name in enumerate(prepared.parameter_names) if name not in of_recordings]]


def _read(content: Mapping[str, Any], known: Sequence[Effect], simulation: Simulation | None) -> DiagnosedModel:
    terms, gammas = [], []
    for entry in content["effects"]:
        columns = entry["drivers"]
        driver = None
        if columns:
            reference = torch.tensor([_finite(c["reference"]) for c in columns], dtype=torch.float64)
            names, units = tuple(c["column"] for c in columns), tuple(c["unit"] for c in columns)
            driver = Driver(names, "", reference.new_zeros(0, len(columns)), reference, units)
        shape = {name: _finite(value) for name, value in entry["shape"].items()}
        effect = _effect(entry, known)
        if "recordings" in entry:
            effect = PerRecording(effect, entry["recordings"], relative=entry.get("relative", False))
        terms.append(Term(effect, driver, shape, entry.get("port", ""), entry.get("first", False)))
        gammas.append(_vector(entry["parameters"]))
    known_fit = Training.from_dict(content["training"]) if "training" in content else None
    theta = _vector(content["parameters"])
    return DiagnosedModel(content["simulation"], content["state"], theta, terms, gammas, simulation, known_fit)


def _effect(entry: Mapping[str, Any], known: Sequence[Effect]) -> Effect:
    """Return the effect of an id; of several forms, the form with these shape parameters."""
    if entry["effect"] == Unrecorded.id and any(name.startswith(COURSE) for name in entry["shape"]):
        return Unrecorded()
    same = [effect for effect in reversed(known) if effect.id == entry["effect"]]
    if not same:
        names = ", ".join(dict.fromkeys(effect.id for effect in known))
        raise ModelFileError(
            f'its effect "{entry["effect"]}" is unknown; register it with `effects=` (known: {names}).'
        )
    numbers = set(entry["shape"])
    of_shape = [effect for effect in same if set(effect.relative) <= numbers]

    def fitting(form: Effect) -> tuple[int, int, int, bool]:
        own, at = {*form.fitted_shape, *form.relative}, str(entry.get("port", "")).partition(" ")[0]
        choices = set(form.form_parameters)
        return -len(choices - numbers), len(choices & numbers), len(own & numbers), form.port == at

    effect = max(of_shape or same, key=fitting)
    lost = sorted({*effect.fitted_shape, *effect.relative} - numbers)
    if lost:
        raise ModelFileError(
            f'the shape of its effect "{effect.id}" lacks {", ".join(lost)}; it may be of another version: diagnose '
            "the recording again."
        )
    return effect


def _vector(values: Sequence[float]) -> Tensor:
    return torch.tensor([_finite(v) for v in values], dtype=torch.float64)


def _finite(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ModelFileError(f"this model is damaged: {value!r} is no finite number.")
    return float(value)


def _context(term: Term, correction: Correction) -> Context:
    port, time, recording = correction.ports[term.port], correction.time, correction.recording
    drivers = time.new_zeros(len(time), 0)
    if term.driver is not None:
        for column in term.driver.columns:
            if column not in recording:
                raise missing_driver(column, term.effect.id)
        drivers = recording.stack(*term.driver.columns) - term.driver.reference
    drivers = port.at(drivers)
    time = time if port.clock is None else port.clock.time
    nothing = time.new_zeros(len(time), len(port.channels))
    return context_at(port, time, drivers, term.driver, nothing)


def missing_driver(column: str, effect: str) -> MissingColumnError:
    """Return the error for a recording without an effect's driver."""
    return MissingColumnError(
        f"The model corrects {effect} by the column `{column}`, which the recording lacks; "
        f"rename it with `--columns {column}=NAME`, or record it."
    )


def correction_of(
    name: str, state: Mapping[str, Any], recording: Recording, simulation: Simulation | None = None
) -> Correction:
    """Return the correction of a recording by a simulation.

    Args:
        name: of the simulation.
        state: of the fitted simulation.
        recording: to correct.
        simulation: of the user.

    Raises:
        ValueError: no simulation of this name corrects recordings, or the given simulation has another name.
        MissingColumnError: the recording lacks a column.
    """
    refuse_unknown(name, simulation)
    known = Magnetometer() if simulation is None else simulation
    if not isinstance(known, CorrectableSimulation):
        raise ValueError(
            f'The simulation "{name}" corrects no recordings; derive it from mkc_torch.simulation.Dynamics or Static.'
        )
    return known.correction(state, recording)


def refuse_unknown(name: str, simulation: Simulation | None) -> None:
    """Raise an error unless the model's simulation is given; a model file never selects code to run.

    Args:
        name: of the model's simulation.
        simulation: the given simulation.

    Raises:
        ValueError: the user's simulation is not given, or another simulation is given.

    Example:
        >>> refuse_unknown("Pendulum", None)
        Traceback (most recent call last):
        ValueError: the model is of the simulation "Pendulum", which is not this package's own: ...
    """
    if simulation is None and name == Paired.name:
        raise ValueError(
            "the model is of a simulator's output: give what it wrote for this recording with `--simulator-output "
            "SIM.csv` "
            "(in Python `simulation=Paired(...)`)."
        )
    if simulation is None and name != Magnetometer.name:
        raise ValueError(
            f'the model is of the simulation "{name}", which is not this package\'s own: no code is run because a '
            f"model's file names it. Give it with `--simulation FILE.py:{name}`, or the FMU that was diagnosed "
            "(in Python `simulation=`)."
        )
    if simulation is not None and simulation.name != name:
        raise ValueError(f'the model is of the simulation "{name}" but "{simulation.name}" was given.')
