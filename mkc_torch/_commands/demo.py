"""``mkc demo``: the whole way on a simulated sensor, whose truth is known."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table

from mkc_torch._commands.console import FAILURES, complain, folder_removed_on_failure, interrupts_told, out
from mkc_torch._commands.summary import show
from mkc_torch._files import claim_folder, write_atomically
from mkc_torch.calibration import Calibration, Vector, calibrate
from mkc_torch.demo import Truth, simulated_recording
from mkc_torch.ellipsoid import EllipsoidFit
from mkc_torch.linear import LeastSquares
from mkc_torch.recording import Recording, write_table
from mkc_torch.report.wording import number

if TYPE_CHECKING:
    from mkc_torch.report import Comparison

_NOTE = (
    "SIMULATED: no sensor recorded this. A program turned a sensor with a known offset and known gains through all "
    "directions for 90 s while a loudspeaker was carried past it, so the truth can stand beside the result."
)


def demo(
    output: Annotated[Path, typer.Option(help="Folder for recording, calibration and report.")] = Path("mkc_demo"),
    force: Annotated[bool, typer.Option("--force", help="Replace existing results.")] = False,
) -> None:
    """Calibrate an embedded SIMULATED sensor and compare the result with the truth; needs no file."""
    try:
        claim_folder(output, overwrite=force)
        with interrupts_told(lambda: _written(output)), folder_removed_on_failure(output):
            calibration, rows, files = _demonstrate(output, force=force)
    except FAILURES as error:
        complain(output, error)
        raise typer.Exit(1) from None
    console = out()
    console.print("SIMULATED sensor: turned by hand for 90 s while a loudspeaker is carried past it.", style="bold")
    show(console, calibration, files)
    console.print()
    console.print(_table(rows))
    console.print(f"\nNext: open {files[-1]}, or", soft_wrap=True)
    command = shlex.join(["mkc", "apply", str(files[1]), str(files[0]), "--output", "corrected.csv"])
    console.print(f"  {command}", soft_wrap=True)


def _written(output: Path) -> str:
    """What an interrupt left."""
    return f"{output} may be incomplete." if output.is_dir() else f"nothing was written to {output}."


def _demonstrate(folder: Path, *, force: bool) -> tuple[Calibration, list[Comparison], list[Path]]:
    from mkc_torch.report import calibration_report

    recording, truth = simulated_recording()
    calibration = calibrate(recording)
    rows = _comparison(recording, truth, calibration)
    files = [folder / name for name in ("recording.csv", "calibration.json", "report.html")]
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


def _table(rows: list[Comparison]) -> Table:
    table = Table(box=None, pad_edge=False, header_style="dim", padding=(0, 2, 0, 0))
    table.add_column("µT, SIMULATED")
    for what in ("offset", "semi-axis"):
        for axis in "xyz" if what == "offset" else "123":
            table.add_column(f"{what} {axis}", justify="right")
    table.add_column("largest error", justify="right")
    truth = (*rows[0].center, *rows[0].semi_axes)
    for row in rows:
        values = (*row.center, *row.semi_axes)
        worst = max(abs(v - t) for v, t in zip(values, truth, strict=True))
        table.add_row(row.name, *(number(v, 2) for v in values), "" if row is rows[0] else number(worst, 2))
    return table
