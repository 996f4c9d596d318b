"""``mkc apply``: correct a recording with a calibration made before."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import torch
import typer

from mkc_torch._commands.console import FAILURES, complain, out, parsed_columns
from mkc_torch.calibration import Calibration
from mkc_torch.recording import Recording, write_table


def apply(
    calibration: Annotated[Path, typer.Argument(metavar="CALIBRATION.json", help="From `mkc calibrate`.")],
    recording: Annotated[Path, typer.Argument(metavar="NEW.csv", help="A recording of the same sensor.")],
    output: Annotated[Path, typer.Option(help="File to write, .csv or .parquet.")],
    columns: Annotated[
        str | None,
        typer.Option(metavar="NAME=COLUMN,...", help="What the columns are called: mag_x=mx,mag_y=my,mag_z=mz"),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace an existing file.")] = False,
) -> None:
    """Write time, field_x, field_y, field_z: the corrected field of a recording, row by row."""
    names = parsed_columns(columns)
    subject = calibration
    try:
        known = Calibration.from_json(_text(calibration))
        subject = recording
        table = Recording.read(recording, columns=names)
        corrected = known.apply(table)
        subject = output
        write_table(output, corrected, overwrite=force)
    except FAILURES as error:
        complain(subject, error)
        raise typer.Exit(1) from None
    field = torch.stack([corrected[f"field_{axis}"] for axis in "xyz"], -1)
    missing = int((~field.isfinite().all(-1)).sum())
    norm = torch.linalg.vector_norm(field, dim=-1)
    console = out()
    for warning in table.warnings:
        console.print(f"warning: {warning}", markup=False, soft_wrap=True)
    if missing:
        console.print(f"warning: {missing} of {len(table)} rows have no finite field.", soft_wrap=True)
    middle = f", median length {float(norm.nanmedian()):.2f} {known.field_unit}" if missing < len(table) else ""
    console.print(f"{len(table):,} rows corrected{middle}: {output}", markup=False, soft_wrap=True)


def _text(path: Path) -> str:
    if path.is_dir():
        raise ValueError(f"{path}: this is a folder; name the calibration.json in it.")
    if not path.exists():
        raise FileNotFoundError(f"{path}: there is no such file.")
    try:
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError:
        raise ValueError(f"{path}: this is no calibration: the file is not text; give it a calibration.json.") from None
