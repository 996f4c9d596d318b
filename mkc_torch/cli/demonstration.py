"""The steps of `mkc demo`: simulate, compute, write and print."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from rich.console import Console
from rich.table import Table
from rich.text import Text

from mkc_torch._support.files import write_atomically
from mkc_torch._support.order_statistic import robust_scale
from mkc_torch.calibration.calibrate import Calibration, Vector, calibrate
from mkc_torch.calibration.ellipsoid_fit import EllipsoidFit
from mkc_torch.cli import diagnosis_summary
from mkc_torch.cli.calibration_summary import show
from mkc_torch.cli.diagnosis_files import write_diagnosis
from mkc_torch.diagnosis import Diagnosis, diagnose
from mkc_torch.linear import LeastSquares
from mkc_torch.recording.demonstration import FIELD_PER_AMPERE, Truth, concealed_recording, simulated_recording
from mkc_torch.recording.kept_columns import write_with_columns
from mkc_torch.recording.recording import Recording, write_table
from mkc_torch.report.diagnosis.numbers import measured
from mkc_torch.report.words.numbers import number
from mkc_torch.simulation import Magnetometer

if TYPE_CHECKING:
    from torch import Tensor

    from mkc_torch.report import Comparison

_NOTE = (
    "SIMULATED: no sensor recorded this. A program turned a sensor with a known offset and known gains through all "
    "directions for 90 s while a loudspeaker was carried past it, so the result can be compared with the truth."
)
_CONCEALED_NOTE = (
    "SIMULATED: no sensor recorded this. A program turned the same sensor for 60 s next to a cable, whose current adds "
    f"{measured(FIELD_PER_AMPERE, None, 'µT/A')[0]} to the field, and made one sample in twenty an outlier. The "
    "diagnosis does not know this."
)
FILES = ("recording.csv", "calibration.json", "report.html", "concealed.csv", "second.csv", "corrected.csv")
CONCEALED = "concealed"


def calibrate_simulated(folder: Path, *, force: bool) -> tuple[Calibration, list[Comparison], list[Path]]:
    from mkc_torch.report import calibration_report

    recording, truth = simulated_recording()
    calibration = calibrate(recording)
    rows = _comparison(recording, truth, calibration)
    files = [folder / name for name in FILES[:3]]
    page = calibration_report(calibration, recording, note=_NOTE, comparison=rows)
    write_table(files[0], recording.columns, overwrite=force)
    write_atomically(files[1], calibration.to_json(), overwrite=force)
    write_atomically(files[2], page, overwrite=force)
    return calibration, rows, files


def _comparison(recording: Recording, truth: Truth, calibration: Calibration) -> list[Comparison]:
    from mkc_torch.report import Comparison

    squares = EllipsoidFit(LeastSquares()).fit(recording.magnetometer())
    return [
        Comparison("truth", truth.center, truth.semi_axes),
        Comparison("least squares", _vector(squares.center_.tolist()), _vector(squares.semi_axes_.tolist())),
        Comparison("MKC-EM", calibration.center, calibration.semi_axes),
    ]


def _vector(values: list[float]) -> Vector:
    x, y, z = values
    return x, y, z


def diagnose_simulated(folder: Path, *, force: bool) -> tuple[Diagnosis, list[Path]]:
    recording = concealed_recording()
    diagnosis = diagnose(Magnetometer(), recording)
    write_table(folder / "concealed.csv", recording.columns, overwrite=force)
    _, files = write_diagnosis(diagnosis, folder / CONCEALED, force=force, note=_CONCEALED_NOTE)
    return diagnosis, [folder / "concealed.csv", *files]


@dataclass(frozen=True)
class Second:
    """Scatter of the field length in a second recording, µT, and the files.

    Attributes:
        calibrated: corrected by a calibration alone.
        corrected: corrected by the model with the findings.
        files: paths of the written files.
    """

    calibrated: float
    corrected: float
    files: list[Path]


def correct_second(folder: Path, diagnosis: Diagnosis, *, force: bool) -> Second:
    """Correct a second recording by the model, and by a calibration of the first recording alone."""
    second = concealed_recording(seed=1)
    assert diagnosis.model is not None
    corrected = diagnosis.model(second)
    files = [folder / "second.csv", folder / "corrected.csv"]
    write_table(files[0], second.columns, overwrite=force)
    field = {name: values for name, values in corrected.items() if name not in second.columns}
    write_with_columns(files[0], files[1], field, overwrite=force)
    alone = calibrate(concealed_recording()).apply(second)
    return Second(_scatter(alone), _scatter(corrected), files)


def _scatter(field: dict[str, Tensor]) -> float:
    length = torch.linalg.vector_norm(torch.stack([field[f"field_{axis}"] for axis in "xyz"], -1), dim=-1)
    return float(robust_scale((length - length.median()).unsqueeze(-1)))


def show_calibration(console: Console, calibration: Calibration, rows: list[Comparison], files: list[Path]) -> None:
    heading = "1  Calibrate. SIMULATED sensor: turned by hand for 90 s while a loudspeaker is carried past it."
    console.print(Text(heading, style="bold"))
    show(console, calibration, files)
    console.print()
    console.print(_table(rows))


def _table(rows: list[Comparison]) -> Table:
    table = Table(box=None, pad_edge=False, header_style="dim", padding=(0, 2, 0, 0))
    table.add_column("µT, SIMULATED")
    offsets = [f"offset {axis}" for axis in "xyz"]
    for name in (*offsets, *(f"semi-axis {i}" for i in (1, 2, 3))):
        table.add_column(name, justify="right")
    table.add_column("largest error", justify="right")
    truth = (*rows[0].center, *rows[0].semi_axes)
    for row in rows:
        values = (*row.center, *row.semi_axes)
        worst = max(abs(v - t) for v, t in zip(values, truth, strict=True))
        table.add_row(row.name, *(number(v, 2) for v in values), "" if row is rows[0] else number(worst, 2))
    return table


def show_diagnosis(console: Console, diagnosis: Diagnosis, files: list[Path], second: Second) -> None:
    heading = "2  Diagnose. SIMULATED sensor next to a cable. The cable's field, below the noise, was left out."
    console.print(Text(f"\n{heading}", style="bold"))
    diagnosis_summary.show(console, diagnosis, files)
    table = Table.grid(padding=(0, 3, 0, 0))
    table.add_row("truth", Text(*measured(FIELD_PER_AMPERE, None, "µT/A, SIMULATED")))
    for found in (p for f in diagnosis.findings for p in f.parameters if p.name == "field_per_ampere"):
        table.add_row("found", Text(*measured(found.value, found.standard_error, found.unit)))
    console.print()
    console.print(table)
    heading = "3  Correct a second recording of that sensor: scatter of the field's length"
    console.print(Text(f"\n{heading}", style="bold"))
    console.print(f"by a calibration alone             {second.calibrated:.2f} µT")
    console.print(f"by the model with the findings     {second.corrected:.2f} µT")
    for file in second.files:
        console.print(Text.assemble(f"{'written':<12}", (str(file), "cyan")), soft_wrap=True)
