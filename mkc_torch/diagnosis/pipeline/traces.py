"""The series that the figures of a report show: residuals, drivers, and the recording with both simulations."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.diagnosis.evidence.base import EvidenceContext
from mkc_torch.diagnosis.evidence.held_out import Evidence
from mkc_torch.diagnosis.model.fit import FittedModel
from mkc_torch.diagnosis.model.process_noise import has_process_noise
from mkc_torch.diagnosis.model.term import Drivers
from mkc_torch.diagnosis.parts import Courses, Traces
from mkc_torch.diagnosis.pipeline.counted import CorrectedModel
from mkc_torch.simulation.protocol import PreparedSimulation
from mkc_torch.simulation.runs import experiment_runs

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int


def traces_of(case: EvidenceContext, drivers: Drivers, corrected: CorrectedModel) -> Traces:
    """Return the series of the figures.

    Args:
        case: the fits without and with findings, and the final parameters.
        drivers: the recorded columns.
        corrected: the simulation with the findings that count.
    """
    prepared, final = case.prepared, case.final.fit
    shown = {
        name: driver.values[:, k] + driver.reference[k]
        for driver in drivers.drivers
        for k, name in enumerate(driver.columns)
    }
    units = {name: unit for driver in drivers.drivers for name, unit in zip(driver.columns, driver.units, strict=True)}
    return Traces(
        time=prepared.time,
        has_time=prepared.recording.time is not None,
        before=case.base.residual,
        after=corrected.fit.residual,
        weight=final.weights,
        channels=prepared.channels,
        unit=prepared.unit,
        drivers=shown,
        driver_units=units,
        with_all=None if corrected.exported is final else final.residual,
        courses=_courses(case, corrected),
    )


def _courses(case: EvidenceContext, corrected: CorrectedModel) -> Courses | None:
    """Return the recording and both simulations; None if the residual is not that of a recorded column."""
    prepared, before = case.prepared, case.base.residual
    if prepared.measured.shape != before.shape or not any(name.startswith("output") for name in prepared.ports):
        return None
    held_out = _shown_fold(case)
    recorded = prepared.measured
    if prepared.recorded is not None:
        recorded = torch.where(prepared.recorded, recorded, torch.nan)
    return Courses(
        recorded,
        _simulated(recorded, case.base, case.held_out[0], held_out),
        _simulated(recorded, corrected.fit, corrected.evidence, held_out),
        held_out,
        _runs(prepared),
        has_process_noise(case.base),
    )


def _shown_fold(case: EvidenceContext) -> Bool[Tensor, " N"]:
    """Return the samples of the middle fold; it has a block in each part of the recording, but not the first one."""
    folds = int(case.blocks.fold.max()) + 1 if len(case.blocks.fold) else 0
    if any(len(model.parameters) != folds or folds < 2 for model in (case.held_out[0], case.held_out[-1])):
        return torch.zeros_like(case.blocks.fold, dtype=torch.bool)
    return case.blocks.fold == folds // 2


def _simulated(
    recorded: Float[Tensor, "N m"], fit: FittedModel, evidence: Evidence, held_out: Bool[Tensor, " N"]
) -> Float[Tensor, "N m"]:
    """Return the simulated outputs: of the fit, and in held-out samples of the fit that has not used them."""
    return recorded - torch.where(held_out.unsqueeze(-1), evidence.residual, fit.residual).detach()


def _runs(prepared: PreparedSimulation) -> Int[Tensor, " N"]:
    """Return the number of each sample's run."""
    if prepared.dynamics is not None:
        return prepared.dynamics.run
    recording = prepared.recording
    if recording.time is None or len(recording) != len(prepared.time):
        return torch.zeros(len(prepared.time), dtype=torch.long)
    return experiment_runs(recording)
