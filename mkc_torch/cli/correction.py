"""Correct recordings with a calibration or a model, for `mkc apply`."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from mkc_torch.calibration import result as calibration_file
from mkc_torch.calibration.calibrate import Calibration
from mkc_torch.calibration.exports.units import unit_ratio
from mkc_torch.calibration.field_messages import magnetic_field_messages
from mkc_torch.cli.console import out
from mkc_torch.cli.early import text_of
from mkc_torch.cli.recorded import ReadAgain
from mkc_torch.diagnosis import DiagnosedModel
from mkc_torch.diagnosis.io import diagnosis_json as diagnosis_file
from mkc_torch.diagnosis.io import model as diagnosed_model
from mkc_torch.diagnosis.io.model import refuse_unknown
from mkc_torch.recording.kept_columns import write_with_columns
from mkc_torch.recording.recording import Recording, write_table
from mkc_torch.report.words.numbers import size
from mkc_torch.simulation import Dynamics, Static
from mkc_torch.simulation.magnetometer import Magnetometer

if TYPE_CHECKING:
    from torch import Tensor

    from mkc_torch.simulation import Simulation

_NOT_MEASURED = ("time", "experiment")

OTHER_LENGTH = 1.15
"""Ratio of field lengths, up or down, beyond which a recording is suspected to be of another unit or place."""

_GIVE = "give a calibration.json of `mkc calibrate` or a model.json of `mkc diagnose`"


def write_correction(recording: Path, output: Path, read: ReadAgain, corrected: Corrected, *, force: bool) -> Corrected:
    """Write the corrected columns, with the recording's other columns if the rows correspond, or with a note if not."""
    table = read.recording
    if not _row_by_row(table, corrected):
        write_table(output, corrected.columns, labels=table.labels, overwrite=force)
        note = "the rows do not correspond to those of the recording, so its other columns are not kept."
        return replace(corrected, notes=(*corrected.notes, note))
    of_file = {name for name in _NOT_MEASURED if name in table}
    own = {name: values for name, values in corrected.columns.items() if name not in of_file}
    write_with_columns(recording, output, own, topic=read.topic, overwrite=force, topics=read.topics)
    return corrected


def _row_by_row(table: Recording, corrected: Corrected) -> bool:
    """Whether the corrected rows are those of the recording."""
    if len(next(iter(corrected.columns.values()))) != len(table):
        return False
    time = corrected.columns.get("time")
    return time is None or table.time is None or bool(torch.equal(time.nan_to_num(), table.time.nan_to_num()))


def show_correction(table: Recording, corrected: Corrected, output: Path) -> None:
    """Print warnings, notes and a summary of the written file."""
    console = out()
    columns = {name: values for name, values in corrected.columns.items() if name not in _NOT_MEASURED}
    field = corrected.field()
    is_field = field is not None
    values = torch.stack(list(columns.values()), -1) if field is None else field
    missing = int((~values.isfinite().all(-1)).sum())
    for warning in table.warnings:
        console.print(f"warning: {warning}", soft_wrap=True)
    for note in (*table.notes, *corrected.notes):
        console.print(f"note: {note}", soft_wrap=True)
    if missing:
        what = "field" if is_field else f"value of {', '.join(columns)}"
        console.print(f"warning: {missing} of {len(values)} rows have no finite {what}.", soft_wrap=True)
    if not is_field:
        sizes = [
            f"RMSE of {name} {size(value)} {corrected.units.get(name, table.units[name])}".rstrip()
            for name, value in corrected.residuals.items()
        ]
        summary = ", ".join([f"{len(values):,} rows of {', '.join(columns)} simulated with the findings", *sizes])
    elif missing < len(values):
        length = float(torch.linalg.vector_norm(values, dim=-1).nanmedian())
        if sentence := _other_length(corrected):
            console.print(f"warning: {sentence}", soft_wrap=True)
        summary = f"{len(values):,} rows corrected, median length {length:.5g} {corrected.unit}".rstrip()
    else:
        summary = f"{len(values):,} rows corrected"
    console.print(f"{summary}: {output}", soft_wrap=True)


def _other_length(corrected: Corrected) -> str | None:
    """Return a warning if the field's length is far from that of the calibrated recording, else None."""
    ratio, expected = corrected.length_ratio(), corrected.length
    if ratio is None or expected is None or abs(math.log(ratio)) < math.log(OTHER_LENGTH):
        return None
    return (
        f"the corrected field's median length is {size(ratio * expected)}, {size(ratio)} times the "
        f"{size(expected)} {corrected.unit} of the calibrated recording; check the unit, the sensor and the place."
    ).replace("  ", " ")


@dataclass(frozen=True)
class Corrected:
    """The corrected columns of a recording.

    Attributes:
        columns: values by name.
        unit: unit of the corrected field, if known.
        length: length of the field in the calibrated recording, if known.
        notes: sentences on effects that were not applied.
        residuals: root mean square of measured minus simulated values, by output.
        units: of the simulation's quantities, by name.
    """

    columns: dict[str, Tensor]
    unit: str
    length: float | None
    notes: tuple[str, ...]
    residuals: Mapping[str, float] = dataclasses.field(default_factory=dict)
    units: Mapping[str, str] = dataclasses.field(default_factory=dict)

    def field(self) -> Tensor | None:
        """The corrected field, (N, 3); None for the outputs of the user's own simulation."""
        for prefix in ("field_", "magnetic_field."):
            names = [f"{prefix}{axis}" for axis in "xyz"]
            if set(names) <= set(self.columns):
                return torch.stack([self.columns[name] for name in names], -1)
        return None

    def length_ratio(self) -> float | None:
        """Median length of the corrected field over that of the calibrated recording; None if either is unknown."""
        vectors = self.field()
        if vectors is None or self.length is None:
            return None
        median = float(torch.linalg.vector_norm(vectors, dim=-1).nanmedian())
        return median / self.length if median > 0.0 else None


def read_correction(path: Path, simulation: Simulation | None = None) -> Calibration | DiagnosedModel:
    """Read a calibration or a model from a file, by its schema.

    Args:
        path: the file.
        simulation: the user's own simulation that was diagnosed. A file never selects the code that is run.

    Raises:
        ValueError: the file is neither, or a model whose simulation is not given.
        OSError: the file cannot be read.
    """
    text = text_of(path)
    try:
        content = json.loads(text)
    except json.JSONDecodeError as error:
        raise ValueError(f"this is neither a calibration nor a model: it is not JSON ({error}); {_GIVE}.") from None
    schema = content.get("schema") if isinstance(content, dict) else None
    if schema == calibration_file.SCHEMA:
        return Calibration.from_json(text)
    if schema == diagnosed_model.SCHEMA:
        known = DiagnosedModel.from_json(text, simulation=simulation)
        refuse_unknown(known.simulation, simulation)
        return known
    if schema == diagnosis_file.SCHEMA:
        raise ValueError("this is a diagnosis.json; give the model.json in the same folder.")
    found = "missing" if schema is None else json.dumps(schema)
    raise ValueError(f"this is neither a calibration nor a model: its schema is {found}; {_GIVE}.")


def with_sizes_of(known: Calibration | DiagnosedModel, recording: str | None) -> Calibration | DiagnosedModel:
    """Return the model with the sizes of a diagnosed recording; unchanged without one.

    Raises:
        ValueError: a calibration, or a model whose sizes do not differ between recordings, or not with this name.
    """
    if recording is None:
        return known
    if isinstance(known, Calibration):
        raise ValueError("a calibration has no sizes of recordings; leave out --sizes-of.")
    return known.with_sizes_of(recording)


def correct(known: Calibration | DiagnosedModel, recording: Recording) -> Corrected:
    """Correct a recording with a calibration or a model.

    Simulated outputs are named ``NAME_simulated``, so that they replace no measured column.
    """
    if isinstance(known, Calibration):
        return Corrected(known.apply(recording), known.field_unit, known.field_strength, ())
    columns, notes = known.correct(recording)
    if known.simulation == Magnetometer.name:
        length = known.state.get("strength")
        unit = str(known.state.get("unit", ""))
        return Corrected(columns, unit, length if isinstance(length, float) else None, notes)
    residuals = {name: _rmse(recording, columns, name) for name in columns if name not in _NOT_MEASURED}
    named = {name if name in _NOT_MEASURED else f"{name}_simulated": values for name, values in columns.items()}
    known_residuals = {name: value for name, value in residuals.items() if math.isfinite(value)}
    units = known.source.units if isinstance(known.source, Dynamics | Static) else {}
    return Corrected(named, "", None, notes, known_residuals, units)


def _rmse(recording: Recording, columns: Mapping[str, Tensor], name: str) -> float:
    """Return the root mean square of measured minus simulated values; nan if none was measured.

    The simulated rows can be fewer than those of the recording, and sorted: they are matched by run and time.
    """
    if name not in recording:
        return math.nan
    rows = zip(_keys(recording, len(recording)), recording[name].tolist(), strict=True)
    measured = dict(reversed(list(rows)))  # of repeated times the first is simulated
    keys = _keys(columns, len(columns[name]))
    pairs = [(measured.get(key, math.nan), value) for key, value in zip(keys, columns[name].tolist(), strict=True)]
    squares = [(known - value) ** 2 for known, value in pairs if math.isfinite(known) and math.isfinite(value)]
    return math.sqrt(sum(squares) / len(squares)) if squares else math.nan


def _keys(table: Recording | Mapping[str, Tensor], count: int) -> list[tuple[float, ...]]:
    """Return run and time of each row; its number without a time."""
    known = [table[name].tolist() for name in ("experiment", "time") if name in table]
    return list(zip(*known, strict=True)) if "time" in table else [(float(row),) for row in range(count)]


def correct_as_messages(known: Calibration | DiagnosedModel, recording: Recording) -> Corrected:
    """Correct a recording to the fields of ``sensor_msgs/MagneticField``.

    Raises:
        ValueError: a model, an accelerometer, or a field in an unknown unit.
    """
    if not isinstance(known, Calibration):
        raise ValueError(
            "--ros needs the noise of a calibration, which a model of `mkc diagnose` does not hold; give the "
            "calibration.json of `mkc calibrate`."
        )
    messages = magnetic_field_messages(known, recording.magnetometer())
    time = {} if recording.time is None else {"time": recording.time}
    strength = known.field_strength * (unit_ratio(known.field_unit, "T") or 1.0)
    return Corrected(time | messages.columns(), "T", strength, ())


def unit_of(known: Calibration | DiagnosedModel) -> str:
    """Return the unit of the measurements behind a calibration or model, "" if there is none."""
    return known.unit if isinstance(known, Calibration) else str(known.state.get("unit", ""))
