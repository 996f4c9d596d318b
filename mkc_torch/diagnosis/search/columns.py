"""Recorded columns with another sign or unit: moves that are tried before any effect is believed."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch

from mkc_torch.diagnosis.model.fit import FittedModel, fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.term import run_parallel
from mkc_torch.diagnosis.score import ScoreBasis, score
from mkc_torch.diagnosis.settings import Settings
from mkc_torch.nonlinear import NoFitError
from mkc_torch.recording.recording import Recording
from mkc_torch.simulation.dynamics.prepared import PreparedDynamics

_DEGREES = math.pi / 180.0

_UNITS: dict[str, tuple[tuple[str, float], ...]] = {
    "rad": (("in degrees", _DEGREES),),
    "rad/s": (("in degrees per second", _DEGREES),),
    "rad/s²": (("in degrees per second squared", _DEGREES),),
    "°": (("in radians", 1.0 / _DEGREES),),
    "m": (("in millimetres", 1e-3),),
    "m/s": (("in millimetres per second", 1e-3),),
    "mm": (("in metres", 1e3),),
    "T": (("in microtesla", 1e-6),),
    "mT": (("in microtesla", 1e-3),),
    "µT": (("in millitesla", 1e3),),
}
"""By the stated unit, another unit that the column may be in, and its factor."""


@dataclass(frozen=True)
class ColumnChange:
    """A column whose values are multiplied by a factor: its sign or its unit is wrong.

    Attributes:
        column: its name.
        role: "input" or "output".
        words: "with the opposite sign", "in degrees", ….
        factor: of the values.
    """

    column: str
    role: str
    words: str
    factor: float

    @property
    def sentence(self) -> str:
        """The change as the beginning of a sentence."""
        return f"{self.role} `{self.column}` {self.words}"


@dataclass(frozen=True)
class ScoredChange:
    """A change of a column, and the score of the simulation alone with it in nats, in the recorded unit."""

    change: ColumnChange
    value: float
    fit: FittedModel


def column_changes(prepared: PreparedDynamics, *, poor: bool) -> list[ColumnChange]:
    """Return the changes to try: the sign of each input, and if the fit is poor also the units of all columns.

    Args:
        prepared: the simulation with its recording.
        poor: whether the simulation alone explains little.
    """
    inputs, outputs = tuple(prepared.system.inputs), prepared.channels
    found = [ColumnChange(name, "input", "with the opposite sign", -1.0) for name in inputs]
    if not poor:
        return found
    found += [ColumnChange(name, "output", "with the opposite sign", -1.0) for name in outputs]
    for role, names in (("input", inputs), ("output", outputs)):
        for name in names:
            unit = prepared.system.units.get(name, prepared.recording.units[name])
            found += [ColumnChange(name, role, words, factor) for words, factor in _UNITS.get(unit, ())]
    return found


def best_change(
    fits: Sequence[FittedModel], basis: ScoreBasis, settings: Settings, *, poor: bool
) -> ScoredChange | None:
    """Return the change of a column with which the simulation alone scores highest; None if none can be fitted.

    Args:
        fits: of the simulation alone.
        basis: what all scores share.
        settings: thresholds.
        poor: whether the simulation alone explains little.
    """
    prepared = fits[0].model.prepared.dynamics
    if prepared is None:
        return None
    changes = column_changes(prepared, poor=poor)
    works = [partial(_scored, change, fits, basis, settings) for change in changes]
    found = [scored for scored in run_parallel(works, prepared) if scored is not None]
    return max(found, key=lambda scored: scored.value, default=None)


def _scored(
    change: ColumnChange, fits: Sequence[FittedModel], basis: ScoreBasis, settings: Settings
) -> ScoredChange | None:
    """Fit and score the simulation alone with a changed column."""
    prepared = fits[0].model.prepared.dynamics
    assert prepared is not None
    changed = _changed(prepared, change)
    best: ScoredChange | None = None
    moved = basis
    if change.role == "output":
        factor = torch.ones(len(prepared.channels), dtype=prepared.time.dtype)
        factor[prepared.channels.index(change.column)] = abs(change.factor)
        moved = _in_unit(basis, factor.numpy(), prepared)
    for start in _starts(changed, fits):
        fit = _fit_from(changed, start)
        found = None if fit is None else score(fit, moved, settings)
        if fit is None or found is None:
            continue
        # a density in another unit: its logarithm changes by that of the factor for each sample that counts
        column = prepared.channels.index(change.column) if change.role == "output" else -1
        jacobian = float(basis.counts[:, column].sum()) * math.log(abs(change.factor)) if column >= 0 else 0.0
        if best is None or found.value + jacobian > best.value:
            best = ScoredChange(change, found.value + jacobian, fit)
    return best


def _in_unit(basis: ScoreBasis, factor: object, prepared: PreparedDynamics) -> ScoreBasis:
    """Return the basis with spans and roundings of the outputs in other units."""
    p = len(basis.largest) - len(prepared.channels)
    largest = basis.largest.copy()
    largest[p:] = largest[p:] * factor
    rounding = tuple(float(value) for value in torch.tensor(basis.rounding).numpy() * factor)
    return replace(basis, span=basis.span * factor, rounding=rounding, largest=largest)


def _starts(changed: PreparedDynamics, fits: Sequence[FittedModel]) -> Iterator[torch.Tensor]:
    """Yield starts of the fit: the user's values, and those of the fits without the change."""
    yield changed.start()
    for fit in fits[:1]:
        start = changed.start()
        number = len(changed.known)
        start[:number] = fit.parameters[:number]
        yield start


def _fit_from(changed: PreparedDynamics, start: torch.Tensor) -> FittedModel | None:
    try:
        return fitted(JointModel(changed), start)
    except NoFitError:
        return None


def _changed(prepared: PreparedDynamics, change: ColumnChange) -> PreparedDynamics:
    """Return the simulation prepared with a changed column."""
    known = prepared.whole
    columns = {name: change.factor * known[name] if name == change.column else known[name] for name in known.names}
    recording = Recording(columns, name=known.name, units=known.units, labels=known.labels)
    return PreparedDynamics(prepared.system, recording, prepared.channels).with_input_hold(prepared.input_hold)
