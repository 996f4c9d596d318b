"""``mkc check``: check a corrected model on recordings that no fit has used."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer

from mkc_torch.cli.console import (
    DOUBTFUL,
    FAILURES,
    ConsoleStyle,
    complain,
    err,
    interrupts_reported,
    not_written,
    out,
    progress,
    refuse_same_names,
)
from mkc_torch.cli.diagnosis_request import Request
from mkc_torch.cli.loading import loading
from mkc_torch.cli.simulation_option import (
    COLUMNS_HELP,
    COLUMNS_METAVAR,
    INPUT_HOLD_HELP,
    OWN_SIMULATION,
    RUN_COLUMN_HELP,
    SIZES_OF_HELP,
    checked_columns,
    checked_input_hold,
    checked_sensor,
    checked_simulation,
    checked_units,
)
from mkc_torch.cli.units_option import CONVERT_HELP, CONVERT_METAVAR, LABEL_HELP, SENSOR_HELP, split_trailing_pairs


def check(
    model: Annotated[Path, typer.Argument(metavar="MODEL.json", help="model.json of `mkc diagnose`.")],
    recordings: Annotated[
        list[Path], typer.Argument(metavar="NEW...", help="Recordings of the same system that no fit has used.")
    ],
    output: Annotated[Path, typer.Option(help="Folder for the results; each NEW gets a subfolder of its name.")] = Path(
        "results"
    ),
    simulation: Annotated[
        str | None, typer.Option(metavar="NAME", help=f"The diagnosed simulation: {OWN_SIMULATION}")
    ] = None,
    simulator_output: Annotated[
        Path | None,
        typer.Option(metavar="SIM.csv", help="Instead of --simulation: the diagnosed simulator's output for NEW."),
    ] = None,
    columns: Annotated[str | None, typer.Option(metavar=COLUMNS_METAVAR, help=COLUMNS_HELP)] = None,
    convert: Annotated[list[str] | None, typer.Option(metavar=CONVERT_METAVAR, help=CONVERT_HELP)] = None,
    unit_label: Annotated[str | None, typer.Option(metavar="UNIT", help=LABEL_HELP)] = None,
    sensor: Annotated[str | None, typer.Option(metavar="NAME", help=SENSOR_HELP)] = None,
    run_column: Annotated[str | None, typer.Option(metavar="COLUMN", help=RUN_COLUMN_HELP)] = None,
    input_hold: Annotated[list[str] | None, typer.Option(metavar="NAME=HOLD", help=INPUT_HOLD_HELP)] = None,
    start_seconds: Annotated[
        float | None,
        typer.Option(
            metavar="SECONDS",
            help="Start of each run from which its initial states are estimated; default: the shortest that is "
            "enough, at least a tenth.",
        ),
    ] = None,
    sizes_of: Annotated[str | None, typer.Option(metavar="RECORDING", help=SIZES_OF_HELP)] = None,
    junit: Annotated[
        Path | None, typer.Option(metavar="FILE.xml", help="Also write the results as JUnit XML, for a build server.")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace existing results.")] = False,
) -> None:
    """Check a model on recordings that no fit has used: are its residuals smaller with the findings than without?

    The initial states are estimated from the first part of each run, and the rest is predicted. For each NEW,
    check.json and check.html, with the picture, are written. A model holds if each output that the findings improve in
    the diagnosed recording is clearly better with them in NEW, and no other output is clearly worse. The exit code is 0
    if the model holds on every NEW, 1 if one could not be checked, and 3 if it does not hold on one, or one was used in
    the fit.
    """
    recordings, conversions = split_trailing_pairs(recordings, convert or [])
    request = Request(
        simulation=checked_simulation(simulation, simulator_output),
        simulator_output=simulator_output,
        columns=checked_columns(columns, run_column),
        units=checked_units(conversions, unit_label, simulation),
        sensor=checked_sensor(sensor, simulation),
        input_hold=checked_input_hold(input_hold or []),
        force=force,
    )
    seconds = _start_seconds(start_seconds)
    refuse_same_names(recordings)
    _refuse_written_inputs(junit, [model, *recordings])
    with loading():
        from mkc_torch.cli.check_files import check_file, model_of
        from mkc_torch.cli.check_summary import show_checks
        from mkc_torch.cli.junit import write_junit
    left, checked = list(recordings), []
    with interrupts_reported(lambda: not_written(left, output)), progress(len(recordings), lines=True) as step:
        try:
            known, request = model_of(model, request, sizes_of)
        except FAILURES as error:
            complain(model, error)
            raise typer.Exit(1) from None
        for path in recordings:
            step(f"checking {path.name}")
            checked.append(check_file(known, path, output / path.stem, request, seconds))
            left.remove(path)
            step(None)
    typer.echo(ConsoleStyle.of(out()).set(lambda console: show_checks(console, checked)), nl=False)
    for each in checked:
        if each.error:
            err().print(f"mkc: {each.error}", soft_wrap=True)
    if junit is not None:
        try:
            write_junit(junit, checked, overwrite=force)
        except FAILURES as error:
            complain(junit, error)
            raise typer.Exit(1) from None
        out().print(f"written       {junit}", soft_wrap=True)
    failed, doubtful = any(each.error for each in checked), any(not each.holds for each in checked)
    raise typer.Exit(1 if failed else DOUBTFUL if doubtful else 0)


def _start_seconds(seconds: float | None) -> float | None:
    if seconds is not None and not (math.isfinite(seconds) and seconds > 0.0):
        raise typer.BadParameter(
            f"--start-seconds must be a number of seconds above 0 but is {seconds:g}; leave it out for the shortest "
            "part that is enough."
        )
    return seconds


def _refuse_written_inputs(junit: Path | None, inputs: list[Path]) -> None:
    """Raise if the file to write is one that is read."""
    if junit is not None and junit.exists() and any(path.exists() and junit.samefile(path) for path in inputs):
        raise typer.BadParameter(f"--junit is the input file {junit}; choose another.")
