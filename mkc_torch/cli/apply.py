"""``mkc apply``: correct a recording with a calibration or a model made before."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mkc_torch.cli.console import FAILURES, complain, interrupts_told, parsed_columns, progress
from mkc_torch.cli.diagnosis_request import SIMULATIONS
from mkc_torch.cli.loading import loading
from mkc_torch.cli.units_option import HELP, METAVAR, SENSOR_HELP, parsed_units


def apply(
    model: Annotated[
        Path,
        typer.Argument(metavar="MODEL.json", help="calibration.json of `mkc calibrate`, model.json of `mkc diagnose`."),
    ],
    recording: Annotated[Path, typer.Argument(metavar="NEW.csv", help="A recording of the same sensor.")],
    output: Annotated[Path, typer.Option(help="File to write, .csv or .parquet.")],
    simulation: Annotated[
        str | None,
        typer.Option(
            metavar="FILE.py:CLASS",
            help="The simulation of your own that was diagnosed, or MODEL.fmu; the code in it is run.",
        ),
    ] = None,
    simulated: Annotated[
        Path | None,
        typer.Option(metavar="SIM.csv", help="What the simulator that was diagnosed wrote for the new recording."),
    ] = None,
    columns: Annotated[
        str | None,
        typer.Option(metavar="NAME=COLUMN,...", help="What the columns are called: mag_x=mx,mag_y=my,mag_z=mz"),
    ] = None,
    unit: Annotated[list[str] | None, typer.Option(metavar=METAVAR, help=HELP)] = None,
    sensor: Annotated[str | None, typer.Option(metavar="NAME", help=SENSOR_HELP)] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace an existing file.")] = False,
) -> None:
    """Write what a calibration or a model makes of a recording, beside the recording's own columns.

    Of a magnetometer: field_x, field_y, field_z, the corrected field row by row. Of a simulation of your own, or of a
    simulator's output: the outputs, simulated with what was found, in the place of the columns of their names. Of a
    model's effects those are left out that belong to the time or the place of the diagnosed recording.
    """
    names, units = parsed_columns(columns), parsed_units(unit or [])
    if simulation is not None and simulated is not None:
        raise typer.BadParameter(
            "--simulation and --simulator-output exclude each other; give the one that was diagnosed."
        )
    with loading():
        from mkc_torch.cli.correction import correct, read_correction, show_correction, unit_of, write_correction
        from mkc_torch.cli.diagnosis_files import named_simulation, paired_simulation
        from mkc_torch.cli.recorded import read_again
        from mkc_torch.simulation.load import raised_in
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
            table, topic = read_again(recording, names, units, sensor, made_in=unit_of(known), of_field=own is None)
            corrected = correct(known, table)
            subject = output
            corrected = write_correction(recording, output, table, corrected, topic=topic, force=force)
    except Exception as error:
        told = raised_in(simulation, error) if simulation and simulation not in SIMULATIONS else None
        if told is None and not isinstance(error, FAILURES):
            raise
        complain(subject, told or error)
        raise typer.Exit(1) from None
    show_correction(table, corrected, output)


def _refuse_input(output: Path, *inputs: Path | None) -> None:
    """Refuses to write over what is read, under whatever name.

    Raises:
        ValueError: the output is one of the inputs.
    """
    for path in inputs:
        if path is not None and output.exists() and path.exists() and output.samefile(path):
            raise ValueError(f"this is {path} itself, which is read and never overwritten; choose another --output.")
