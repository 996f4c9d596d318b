"""``mkc apply``: correct a recording with a calibration or a model made before."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import torch
import typer

from mkc_torch import calibration_file
from mkc_torch._commands.console import FAILURES, complain, out, parsed_columns
from mkc_torch.calibration import Calibration
from mkc_torch.diagnosis import DiagnosedModel, diagnosed_model, diagnosis_file
from mkc_torch.recording import Recording, write_table

if TYPE_CHECKING:
    from torch import Tensor


def apply(
    model: Annotated[
        Path,
        typer.Argument(metavar="MODEL.json", help="calibration.json of `mkc calibrate`, model.json of `mkc diagnose`."),
    ],
    recording: Annotated[Path, typer.Argument(metavar="NEW.csv", help="A recording of the same sensor.")],
    output: Annotated[Path, typer.Option(help="File to write, .csv or .parquet.")],
    columns: Annotated[
        str | None,
        typer.Option(metavar="NAME=COLUMN,...", help="What the columns are called: mag_x=mx,mag_y=my,mag_z=mz"),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace an existing file.")] = False,
) -> None:
    """Write time, field_x, field_y, field_z: the corrected field of a recording, row by row.

    Of a model's effects those are left out that belong to the time or the place of the diagnosed recording.
    """
    names = parsed_columns(columns)
    subject = model
    try:
        known = read_correction(model)
        subject = recording
        table = Recording.read(recording, columns=names)
        corrected = correct(known, table)
        subject = output
        write_table(output, corrected.columns, overwrite=force)
    except FAILURES as error:
        complain(subject, error)
        raise typer.Exit(1) from None
    field = torch.stack([corrected.columns[f"field_{axis}"] for axis in "xyz"], -1)
    missing = int((~field.isfinite().all(-1)).sum())
    norm = torch.linalg.vector_norm(field, dim=-1)
    console = out()
    for warning in table.warnings:
        console.print(f"warning: {warning}", markup=False, soft_wrap=True)
    for note in corrected.notes:
        console.print(f"note: {note}", markup=False, soft_wrap=True)
    if missing:
        console.print(f"warning: {missing} of {len(table)} rows have no finite field.", soft_wrap=True)
    middle = f", median length {float(norm.nanmedian()):.2f} {corrected.unit}" if missing < len(table) else ""
    console.print(f"{len(table):,} rows corrected{middle.rstrip()}: {output}", markup=False, soft_wrap=True)


@dataclass(frozen=True)
class Corrected:
    """The corrected field of a recording, its unit if it is known, and sentences about what was left out."""

    columns: dict[str, Tensor]
    unit: str
    notes: tuple[str, ...]


def read_correction(path: Path) -> Calibration | DiagnosedModel:
    """What a file holds, a calibration or a model, by its schema.

    Raises:
        ValueError: neither of the two.
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
        return DiagnosedModel.from_json(text)
    if schema == diagnosis_file.SCHEMA:
        raise ValueError("this is what a diagnosis says; give the model.json beside it.")
    found = "missing" if schema is None else json.dumps(schema)
    raise ValueError(
        f"this is neither a calibration nor a model: its schema is {found}; give a calibration.json of `mkc calibrate` "
        "or a model.json of `mkc diagnose`."
    )


def correct(known: Calibration | DiagnosedModel, recording: Recording) -> Corrected:
    """The recording as the calibration or the model corrects it."""
    if isinstance(known, Calibration):
        return Corrected(known.apply(recording), known.field_unit, ())
    columns, notes = known.correct(recording)
    return Corrected(columns, "", notes)


def _text(path: Path) -> str:
    if path.is_dir():
        raise ValueError(f"{path}: this is a folder; name the calibration.json or model.json in it.")
    if not path.exists():
        raise FileNotFoundError(f"{path}: there is no such file.")
    try:
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError:
        raise ValueError(f"{path}: the file is not text; give a calibration.json or a model.json.") from None
