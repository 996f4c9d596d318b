"""Correction of a magnetometer model as offset, matrix and field of a current, for exports."""

from __future__ import annotations

import torch
from torch import Tensor

from mkc_torch._support.unit_text import ratio
from mkc_torch.calibration.exports import CurrentCoefficients, ExportError, SensorCorrection
from mkc_torch.calibration.plain_values import matrix_of, vector_of
from mkc_torch.diagnosis.io.model import DiagnosedModel, correction_of
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.recording.recording import Recording
from mkc_torch.simulation.magnetometer import Magnetometer


def sensor_correction(model: DiagnosedModel, name: str) -> SensorCorrection:
    """Return the affine part of a model's correction, with notes on the effects that are left out.

    The offset includes the final offset of effects that depend on the time of the diagnosed recording, as in
    :meth:`DiagnosedModel.correct`.

    Args:
        model: of a magnetometer.
        name: of the sensor.

    Raises:
        ExportError: the model is of another simulation.

    Example:
        >>> theta = torch.tensor([12.0, -8.0, 21.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0], dtype=torch.float64)
        >>> state = {"view": "norm", "unit": "µT", "strength": 48.0}
        >>> found = sensor_correction(DiagnosedModel("magnetometer", state, theta, [], []), "mast")
        >>> found.offset, found.field_strength
        ((12.0, -8.0, 21.0), 48.0)
    """
    if model.simulation != Magnetometer.name:
        raise ExportError(
            f'the model is of the simulation "{model.simulation}", and only magnetometers are exported; what it '
            "corrects is written by `mkc apply`."
        )
    unit = str(model.state.get("unit", ""))
    kept, current, text = _kept(model, unit)
    matrix, offset = _affine(_reduced(model, kept), unit, None)
    strength = model.state.get("strength")
    already = str(model.state.get("corrected_already", ""))
    field = None
    if current is not None:
        field = _field_of_current(model, kept, current, unit, offset)
    return SensorCorrection(
        name=name,
        unit=unit,
        offset=vector_of(offset),
        matrix=matrix_of(matrix),
        field_unit=unit,
        field_strength=strength if isinstance(strength, float) else None,
        current=field,
        left_out=(*([already] if already else []), *text),
        corrected_already=already,
    )


def _kept(model: DiagnosedModel, unit: str) -> tuple[list[int], int | None, list[str]]:
    """Return the numbers of the exported terms, the number of the current's term, and the notes."""
    ports = correction_of(model.simulation, model.state, _probe(unit, {})).ports
    kept: list[int] = []
    current: int | None = None
    sentences = []
    for number, term in enumerate(model.terms):
        effect = term.effect.id
        if term.port not in ports:
            sentences.append(f"{effect} depends on the location of the diagnosed recording and is left out.")
        elif term.effect.persistent_change:
            kept.append(number)
            sentences.append(f"{effect} depends on the time of the diagnosed recording: its final offset is included.")
        elif current is None and _is_current(term):
            kept.append(number)
            current = number
        else:
            sentences.append(f"{effect} is left out: {_why(term, current is not None)}")
    return kept, current, sentences


def _is_current(term: Term) -> bool:
    if term.effect.id != "current_field" or term.driver is None or len(term.driver.columns) != 1:
        return False
    return ratio(term.driver.units[0], "A") is not None


def _why(term: Term, current_taken: bool) -> str:
    driver = term.driver
    if driver is None:
        return "an export holds an offset, a matrix and the field of a current."
    means = ", ".join(
        f"`{column}` = {float(mean):.4g} {unit}".rstrip()
        for column, mean, unit in zip(driver.columns, driver.reference, driver.units, strict=True)
    )
    why = "an export holds an offset, a matrix and the field of a current"
    if term.effect.id == "current_field":
        why = (
            "an export holds the field of one current"
            if current_taken
            else "its column is in no known unit of a current, such as A"
        )
    return f"{why}. The offset is that at {means}."


def _field_of_current(
    model: DiagnosedModel, kept: list[int], number: int, unit: str, offset: Tensor
) -> CurrentCoefficients:
    """Return the change of the offset per ampere."""
    driver = model.terms[number].driver
    assert driver is not None
    amperes = ratio(driver.units[0], "A")
    assert amperes is not None
    _, more = _affine(_reduced(model, kept), unit, driver.columns[0])
    return CurrentCoefficients(
        vector_of((more - offset) / amperes), float(driver.reference[0]) * amperes, driver.columns[0]
    )


def _reduced(model: DiagnosedModel, kept: list[int]) -> DiagnosedModel:
    terms, gammas = [model.terms[k] for k in kept], [model.gammas[k] for k in kept]
    return DiagnosedModel(model.simulation, model.state, model.theta, terms, gammas)


def _affine(model: DiagnosedModel, unit: str, raised: str | None) -> tuple[Tensor, Tensor]:
    """Return matrix and offset from the model's correction of readings on the axes; ``raised`` adds 1 to a column."""
    drivers: dict[str, float] = {}
    for term in model.terms:
        if term.driver is not None:
            drivers |= dict(zip(term.driver.columns, term.driver.reference.tolist(), strict=True))
    if raised is not None:
        drivers[raised] += 1.0
    columns, _ = model.correct(_probe(unit, drivers))
    field = torch.stack([columns[f"field_{axis}"] for axis in "xyz"], -1)
    matrix = (field[1:] - field[0]).mT
    return matrix, -torch.linalg.solve(matrix, field[0])


def _probe(unit: str, drivers: dict[str, float]) -> Recording:
    """Return readings of 0, and of 1 along each axis."""
    points = torch.cat([torch.zeros(1, 3, dtype=torch.float64), torch.eye(3, dtype=torch.float64)])
    columns = {f"mag_{axis}": values for axis, values in zip("xyz", points.unbind(-1), strict=True)}
    units = dict.fromkeys(columns, unit)
    return Recording(
        columns | {name: torch.full((4,), value, dtype=torch.float64) for name, value in drivers.items()}, units=units
    )
