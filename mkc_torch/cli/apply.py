"""``mkc apply``: correct a recording with a calibration or a model made before."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import torch
import typer

from mkc_torch.calibration import result as calibration_file
from mkc_torch.calibration.calibrate import Calibration
from mkc_torch.cli.console import FAILURES, complain, interrupts_told, out, parsed_columns, progress
from mkc_torch.cli.diagnosis_files import SIMULATIONS, named_simulation, paired_simulation
from mkc_torch.diagnosis import DiagnosedModel
from mkc_torch.diagnosis.files import diagnosis_json as diagnosis_file
from mkc_torch.diagnosis.files import model as diagnosed_model
from mkc_torch.diagnosis.files.model import refuse_unknown
from mkc_torch.recording.kept_columns import write_beside
from mkc_torch.recording.recording import Recording, write_table
from mkc_torch.report.words.numbers import size
from mkc_torch.simulation.load import raised_in

if TYPE_CHECKING:
    from torch import Tensor

    from mkc_torch.simulation import Simulation

_NOT_MEASURED = ("time", "experiment")

_OTHER_LENGTH = 1.5
"""How many times longer or shorter a field is that is not the one a correction was made in."""


def apply(
    model: Annotated[
        Path,
        typer.Argument(metavar="MODEL.json", help="calibration.json of `mkc calibrate`, model.json of `mkc diagnose`."),
    ],
    recording: Annotated[Path, typer.Argument(metavar="NEW.csv", help="A recording of the same sensor.")],
    output: Annotated[Path, typer.Option(help="File to write, .csv or .parquet.")],
    simulation: Annotated[
        str | None,
        typer.Option(metavar="FILE.py:CLASS", help="The simulation of your own that was diagnosed; its code is run."),
    ] = None,
    simulated: Annotated[
        Path | None,
        typer.Option(metavar="SIM.csv", help="What the simulator that was diagnosed wrote for the new recording."),
    ] = None,
    columns: Annotated[
        str | None,
        typer.Option(metavar="NAME=COLUMN,...", help="What the columns are called: mag_x=mx,mag_y=my,mag_z=mz"),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace an existing file.")] = False,
) -> None:
    """Write what a calibration or a model makes of a recording, beside the recording's own columns.

    Of a magnetometer: field_x, field_y, field_z, the corrected field row by row. Of a simulation of your own, or of a
    simulator's output: the outputs, simulated with what was found, in the place of the columns of their names. Of a
    model's effects those are left out that belong to the time or the place of the diagnosed recording.
    """
    names = parsed_columns(columns)
    if simulation is not None and simulated is not None:
        raise typer.BadParameter("--simulation and --simulated exclude each other; give the one that was diagnosed.")
    subject: str | Path = model
    try:
        with interrupts_told(lambda: f"nothing was written to {output}."), progress(1) as step:
            step(f"correcting {recording.name}")
            own = None
            if simulation is not None or simulated is not None:
                subject = str(simulation or simulated)
                own = named_simulation(simulation) if simulation else paired_simulation(Path(subject), names)
            subject = model
            known = read_correction(model, own)
            subject = output
            _refuse_input(output, recording, model, simulated)
            subject = recording
            table = Recording.read(recording, columns=names)
            corrected = correct(known, table)
            subject = output
            corrected = _written(recording, output, table, corrected, force=force)
    except Exception as error:
        told = raised_in(simulation, error) if simulation and simulation not in SIMULATIONS else None
        if told is None and not isinstance(error, FAILURES):
            raise
        complain(subject, told or error)
        raise typer.Exit(1) from None
    _show(table, corrected, output)


def _written(recording: Path, output: Path, table: Recording, corrected: Corrected, *, force: bool) -> Corrected:
    """Writes the file, with the columns of the recording where the rows are its rows; says so where they are not."""
    if not _row_by_row(table, corrected):
        write_table(output, corrected.columns, labels=table.labels, overwrite=force)
        note = "the rows are not those of the recording, so its other columns are not kept."
        return replace(corrected, notes=(*corrected.notes, note))
    of_file = {name for name in _NOT_MEASURED if name in table}
    own = {name: values for name, values in corrected.columns.items() if name not in of_file}
    write_beside(recording, output, own, overwrite=force)
    return corrected


def _row_by_row(table: Recording, corrected: Corrected) -> bool:
    """Whether what was corrected stands in the rows of the recording."""
    if len(next(iter(corrected.columns.values()))) != len(table):
        return False
    time = corrected.columns.get("time")
    return time is None or table.time is None or bool(torch.equal(time.nan_to_num(), table.time.nan_to_num()))


def _refuse_input(output: Path, *inputs: Path | None) -> None:
    """Refuses to write over what is read, under whatever name.

    Raises:
        ValueError: the output is one of the inputs.
    """
    for path in inputs:
        if path is not None and output.exists() and path.exists() and output.samefile(path):
            raise ValueError(f"this is {path} itself, which is read and never overwritten; choose another --output.")


def _show(table: Recording, corrected: Corrected, output: Path) -> None:
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


def _text(path: Path) -> str:
    if path.is_dir():
        raise ValueError(f"{path}: this is a folder; name the calibration.json or model.json in it.")
    if not path.exists():
        raise FileNotFoundError(f"{path}: there is no such file.")
    try:
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError:
        raise ValueError(f"{path}: the file is not text; give a calibration.json or a model.json.") from None
