"""Recordings as a calibration or a model corrects them: what `mkc apply` and `mkc challenge` both run."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from mkc_torch.calibration import result as calibration_file
from mkc_torch.calibration.calibrate import Calibration
from mkc_torch.cli.console import out
from mkc_torch.diagnosis import DiagnosedModel
from mkc_torch.diagnosis.io import diagnosis_json as diagnosis_file
from mkc_torch.diagnosis.io import model as diagnosed_model
from mkc_torch.diagnosis.io.model import refuse_unknown
from mkc_torch.recording.kept_columns import write_beside
from mkc_torch.recording.recording import Recording, write_table
from mkc_torch.report.words.numbers import size

if TYPE_CHECKING:
    from torch import Tensor

    from mkc_torch.simulation import Simulation

__all__ = ["Corrected", "correct", "read_correction", "show_correction", "unit_of", "write_correction"]

_NOT_MEASURED = ("time", "experiment")

_OTHER_LENGTH = 1.5
"""How many times longer or shorter a field is that is not the one a correction was made in."""


def write_correction(
    recording: Path, output: Path, table: Recording, corrected: Corrected, *, topic: int = 0, force: bool
) -> Corrected:
    """Writes the file, with the columns of the recording where the rows are its rows; says so where they are not."""
    if not _row_by_row(table, corrected):
        write_table(output, corrected.columns, labels=table.labels, overwrite=force)
        note = "the rows are not those of the recording, so its other columns are not kept."
        return replace(corrected, notes=(*corrected.notes, note))
    of_file = {name for name in _NOT_MEASURED if name in table}
    own = {name: values for name, values in corrected.columns.items() if name not in of_file}
    write_beside(recording, output, own, topic=topic, overwrite=force)
    return corrected


def _row_by_row(table: Recording, corrected: Corrected) -> bool:
    """Whether what was corrected stands in the rows of the recording."""
    if len(next(iter(corrected.columns.values()))) != len(table):
        return False
    time = corrected.columns.get("time")
    return time is None or table.time is None or bool(torch.equal(time.nan_to_num(), table.time.nan_to_num()))


def show_correction(table: Recording, corrected: Corrected, output: Path) -> None:
    """Print what was written, and what to notice of it."""
    console = out()
    columns = {name: values for name, values in corrected.columns.items() if name not in _NOT_MEASURED}
    values = torch.stack(list(columns.values()), -1)
    missing = int((~values.isfinite().all(-1)).sum())
    is_field = set(columns) == {f"field_{axis}" for axis in "xyz"}
    for warning in table.warnings:
        console.print(f"warning: {warning}", soft_wrap=True)
    for note in corrected.notes:
        console.print(f"note: {note}", soft_wrap=True)
    if missing:
        what = "field" if is_field else f"value of {', '.join(columns)}"
        console.print(f"warning: {missing} of {len(values)} rows have no finite {what}.", soft_wrap=True)
    if not is_field:
        told = f"{len(values):,} rows of {', '.join(columns)} simulated with what was found"
    elif missing < len(values):
        length = float(torch.linalg.vector_norm(values, dim=-1).nanmedian())
        if sentence := _other(length, corrected):
            console.print(f"warning: {sentence}", soft_wrap=True)
        told = f"{len(values):,} rows corrected, median length {length:.5g} {corrected.unit}".rstrip()
    else:
        told = f"{len(values):,} rows corrected"
    console.print(f"{told}: {output}", soft_wrap=True)


def _other(length: float, corrected: Corrected) -> str | None:
    """A sentence about a field of quite another length than that of the recording which the correction is from."""
    expected, unit = corrected.length, corrected.unit
    if expected is None or not length > 0 or abs(math.log(length / expected)) < math.log(_OTHER_LENGTH):
        return None
    return (
        f"the corrected field's median length is {size(length)}, {size(length / expected)} times the "
        f"{size(expected)} {unit} of the recording that this was made from: is this one in another unit, or of another "
        "sensor or place?"
    ).replace("  ", " ")


@dataclass(frozen=True)
class Corrected:
    """The corrected columns of a recording.

    Attributes:
        columns: name to values.
        unit: of the corrected field, if it is known.
        length: of the field where the correction was made, if it is known.
        notes: sentences about what was left out.
    """

    columns: dict[str, Tensor]
    unit: str
    length: float | None
    notes: tuple[str, ...]


def read_correction(path: Path, simulation: Simulation | None = None) -> Calibration | DiagnosedModel:
    """What a file holds, a calibration or a model, by its schema.

    Args:
        path: of the file.
        simulation: the user's own that was diagnosed. A file never says what code is run.

    Raises:
        ValueError: neither of the two, or a model of a simulation that is not given.
        OSError: the file cannot be read.
    """
    text = _text(path)
    try:
        content = json.loads(text)
    except json.JSONDecodeError as error:
        raise ValueError(f"this is neither a calibration nor a model: it is not JSON ({error}).") from None
    schema = content.get("schema") if isinstance(content, dict) else None
    if schema == calibration_file.SCHEMA:
        return Calibration.from_json(text)
    if schema == diagnosed_model.SCHEMA:
        known = DiagnosedModel.from_json(text, simulation=simulation)
        refuse_unknown(known.simulation, simulation)
        return known
    if schema in diagnosis_file.SCHEMAS:
        raise ValueError("this is what a diagnosis says; give the model.json beside it.")
    found = "missing" if schema is None else json.dumps(schema)
    raise ValueError(
        f"this is neither a calibration nor a model: its schema is {found}; give a calibration.json of `mkc calibrate` "
        "or a model.json of `mkc diagnose`."
    )


def correct(known: Calibration | DiagnosedModel, recording: Recording) -> Corrected:
    """The recording as the calibration or the model corrects it."""
    if isinstance(known, Calibration):
        return Corrected(known.apply(recording), known.field_unit, known.field_strength, ())
    columns, notes = known.correct(recording)
    length = known.state.get("strength")
    return Corrected(columns, str(known.state.get("unit", "")), length if isinstance(length, float) else None, notes)


def unit_of(known: Calibration | DiagnosedModel) -> str:
    """The unit of the measurements that a calibration or a model was made from; empty where it has none."""
    return known.unit if isinstance(known, Calibration) else str(known.state.get("unit", ""))


def _text(path: Path) -> str:
    if path.is_dir():
        raise ValueError(f"{path}: this is a folder; name the calibration.json or model.json in it.")
    if not path.exists():
        raise FileNotFoundError(f"{path}: there is no such file.")
    try:
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError:
        raise ValueError(f"{path}: the file is not text; give a calibration.json or a model.json.") from None
