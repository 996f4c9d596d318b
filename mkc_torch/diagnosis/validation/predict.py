"""Predict the outputs of a recording: initial states from the first part of each trajectory, the rest predicted."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.diagnosis.goodness_of_fit import units_of
from mkc_torch.diagnosis.io.model import DiagnosedModel, correction_of
from mkc_torch.diagnosis.validation.first_part import checked_start, enough_seconds
from mkc_torch.recording.recording import Recording
from mkc_torch.simulation.dynamics import Dynamics
from mkc_torch.simulation.dynamics.correction import DynamicsCorrection
from mkc_torch.simulation.magnetometer import Magnetometer
from mkc_torch.simulation.parameter import SimulationError
from mkc_torch.simulation.protocol import PreparedSimulation, Simulation
from mkc_torch.simulation.runs import experiment_runs

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

_ACCURATE = 1e-6
"""Change by half the step of integration, as a share of each output's range, up to which the step is halved."""

NORM = "length of the field"
"""Output of a magnetometer's model: its corrected field's length, as a share of the median length."""


@dataclass(frozen=True)
class Prediction:
    """Measured and simulated outputs of a recording.

    Attributes:
        recording: the N samples in use.
        columns: names of the recorded columns that are compared.
        outputs, units: names and units of the m outputs.
        time: (N,), in s.
        run: (N,), number of each sample's run.
        measured: (N, m); nan where an output is missing.
        simulated: (N, m).
        predicted: (N,), False for the samples that the initial states were estimated from.
        start_seconds: s from the start of each trajectory that these are; None for a simulation without states.
        initial: (K, n), the initial states of the trajectories; None for a simulation without states.
        accuracy: change of the simulated outputs by half the step of integration, as a share of an output's range.
        notes: sentences about effects that do not transfer.
    """

    recording: Recording
    columns: tuple[str, ...]
    outputs: tuple[str, ...]
    units: tuple[str, ...]
    time: Float[Tensor, " N"]
    run: Int[Tensor, " N"]
    measured: Float[Tensor, "N m"]
    simulated: Float[Tensor, "N m"]
    predicted: Bool[Tensor, " N"]
    start_seconds: float | None = None
    initial: Float[Tensor, "K n"] | None = None
    accuracy: float = 0.0
    notes: tuple[str, ...] = ()

    @property
    def residual(self) -> Float[Tensor, "N m"]:
        """Measured minus simulated outputs; nan where an output is missing."""
        return self.measured - self.simulated

    @property
    def explained(self) -> tuple[float, ...]:
        """Share of each output's variance that the simulation explains in the predicted samples.

        It is nan where the measured values are the same in all samples, and for a magnetometer.
        """
        shares = []
        for measured, residual in zip(self.measured.unbind(-1), self.residual.unbind(-1), strict=True):
            seen = self.predicted & measured.isfinite()
            variance = float(measured[seen].var(correction=0)) if bool(seen.any()) else 0.0
            left = float(residual[seen].square().mean()) if variance > 0.0 else 0.0
            shares.append(1.0 - left / variance if variance > 0.0 else math.nan)
        return tuple(shares)


def predict(model: DiagnosedModel, recording: Recording, start_seconds: float | None = None) -> Prediction:
    """Predict the outputs of a recording by a model.

    Args:
        model: the simulation with its findings, or without any.
        recording: of the same system.
        start_seconds: s from the start of each trajectory that the initial states are estimated from; None for the
            simulation's ``initial_window``, or if it has none, for a tenth of the shortest trajectory, but at least
            five samples for each initial state.

    Raises:
        MissingColumnError: a column of the simulation, or an effect's driver, is missing.
        ValueError: ``start_seconds`` is out of range, or the trajectories are too short.
        SimulationError: no trajectory is found.
    """
    source = model.source
    if isinstance(source, Dynamics):
        return _of_dynamics(model, recording, start_seconds)
    if start_seconds is not None:
        raise ValueError(
            f"Expected argument `start_seconds` to be None but got {start_seconds:g}: {model.simulation} has no "
            "initial states; all samples are predicted. Leave it out (`--start-seconds`)."
        )
    return (
        _of_magnetometer(model, recording)
        if source is None or isinstance(source, Magnetometer)
        else _of_outputs(model, source, recording)
    )


def _of_dynamics(model: DiagnosedModel, recording: Recording, start_seconds: float | None) -> Prediction:
    plain = correction_of(model.simulation, model.state, recording, model.source)
    assert isinstance(plain, DynamicsCorrection)
    prepared = plain.prepared
    first = checked_start(prepared, plain.first if start_seconds is None else start_seconds)
    correction = DynamicsCorrection(prepared, first)
    changes, notes = model.changes(correction)
    starts = correction.initial_states(model.theta, changes)
    if start_seconds is None and plain.first is None:
        first = enough_seconds(correction, model.theta, changes, starts)
        correction = DynamicsCorrection(prepared, first)
        starts = correction.initial_states(model.theta, changes, starts.values)
    simulated = correction.simulated(model.theta, changes, starts)
    spread = (prepared.measured.amax(0) - prepared.measured.amin(0)).clamp(min=torch.finfo(simulated.dtype).tiny)
    accuracy = 0.0
    while (finer := correction.finer()) is not None:
        changes, _ = model.changes(finer)
        starts = finer.initial_states(model.theta, changes, starts.values)
        again = finer.simulated(model.theta, changes, starts)
        accuracy = float(((again - simulated).abs().amax(0) / spread).max())
        correction, simulated = finer, again
        if accuracy <= _ACCURATE:
            break
    if not bool(simulated.isfinite().all()):
        raise SimulationError(
            f"{prepared.name}: the trajectory from the estimated initial states is not finite; give another "
            "`start_seconds` (`--start-seconds`), or a smaller `step`."
        )
    measured = prepared.measured
    if prepared.recorded is not None:
        measured = torch.where(prepared.recorded, measured, torch.nan)
    return Prediction(
        prepared.whole,
        prepared.channels,
        prepared.channels,
        units_of(prepared),
        prepared.time,
        prepared.run,
        measured,
        simulated,
        prepared.time_since_start() > first,
        first,
        starts.values.unflatten(0, (-1, len(prepared.system.states))),
        accuracy,
        notes,
    )


def _of_outputs(model: DiagnosedModel, source: Simulation, recording: Recording) -> Prediction:
    prepared = source.prepare(recording)
    table, units = with_measured(prepared), dict(zip(prepared.channels, units_of(prepared), strict=True))
    correction = correction_of(model.simulation, model.state, table, source)
    changes, notes = model.changes(correction)
    found = correction.corrected(model.theta, changes)
    outputs = tuple(name for name in found if name not in ("time", "experiment"))
    return Prediction(
        table,
        outputs,
        outputs,
        tuple(units.get(name, "") for name in outputs),
        correction.time,
        _runs(table),
        table.stack(*outputs),
        torch.stack([found[name] for name in outputs], -1).detach(),
        torch.ones(len(table), dtype=torch.bool),
        notes=notes,
    )


def with_measured(prepared: PreparedSimulation) -> Recording:
    """Return the recording of a prepared simulation with all measured columns, and with missing outputs as nan.

    A simulator's output is prepared with a recording without the compared columns.
    """
    if prepared.dynamics is not None:
        return prepared.dynamics.whole
    table = prepared.recording
    if prepared.measured.shape[-1] != len(prepared.channels) or all(name in table for name in prepared.channels):
        return table
    units = dict(zip(prepared.channels, units_of(prepared), strict=True))
    columns = dict(zip(prepared.channels, prepared.measured.unbind(-1), strict=True))
    return Recording(
        {**table.columns, **columns},
        name=table.name,
        units={**table.units, **units},
        warnings=table.warnings,
        labels=table.labels,
    )


def _of_magnetometer(model: DiagnosedModel, recording: Recording) -> Prediction:
    table = recording.finite("mag_x", "mag_y", "mag_z")
    table = table if table.time is None else table.sorted_by_time()
    correction = correction_of(model.simulation, model.state, table, model.source)
    changes, notes = model.changes(correction)
    found = correction.corrected(model.theta, changes)
    length = torch.linalg.vector_norm(torch.stack([found[f"field_{axis}"] for axis in "xyz"], -1).detach(), dim=-1)
    # the field's length differs from place to place, so only its spread is compared
    share = (length / length.nanmedian()).unsqueeze(-1)
    return Prediction(
        table,
        ("mag_x", "mag_y", "mag_z"),
        (NORM,),
        ("of its median",),
        correction.time,
        _runs(table),
        torch.ones_like(share),
        share,
        torch.ones(len(table), dtype=torch.bool),
        notes=notes,
    )


def _runs(table: Recording) -> Int[Tensor, " N"]:
    return torch.zeros(len(table), dtype=torch.long) if table.time is None else experiment_runs(table)
