"""``mkc apply``: correct a recording with an existing calibration or model."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from mkc_torch.cli.console import FAILURES, complain, interrupts_reported, parsed_columns, progress
from mkc_torch.cli.diagnosis_request import SIMULATIONS
from mkc_torch.cli.early import refuse_no_text, refuse_unreadable
from mkc_torch.cli.loading import loading
from mkc_torch.cli.simulation_option import SIZES_OF_HELP
from mkc_torch.cli.units_option import CONVERT_HELP, CONVERT_METAVAR, LABEL_HELP, SENSOR_HELP, parsed_units


def apply(
    model: Annotated[
        Path,
        typer.Argument(metavar="MODEL.json", help="calibration.json of `mkc calibrate`, model.json of `mkc diagnose`."),
    ],
    recording: Annotated[Path, typer.Argument(metavar="NEW.csv", help="A new recording of the same sensor or system.")],
    output: Annotated[Path, typer.Option(help="File to write: .csv or .parquet.")],
    simulation: Annotated[
        str | None,
        typer.Option(
            metavar="FILE.py:CLASS",
            help="Your diagnosed simulation, MODEL.fmu or MODEL.xml; its code is run.",
        ),
    ] = None,
    simulator_output: Annotated[
        Path | None,
        typer.Option(metavar="SIM.csv", help="Table that the diagnosed simulator wrote for the new recording."),
    ] = None,
    columns: Annotated[
        str | None,
        typer.Option(metavar="NAME=COLUMN,...", help="Names of the columns in the file: mag_x=mx,mag_y=my,mag_z=mz"),
    ] = None,
    convert: Annotated[list[str] | None, typer.Option(metavar=CONVERT_METAVAR, help=CONVERT_HELP)] = None,
    unit_label: Annotated[str | None, typer.Option(metavar="UNIT", help=LABEL_HELP)] = None,
    sensor: Annotated[str | None, typer.Option(metavar="NAME", help=SENSOR_HELP)] = None,
    sizes_of: Annotated[str | None, typer.Option(metavar="RECORDING", help=SIZES_OF_HELP)] = None,
    ros: Annotated[
        bool,
        typer.Option("--ros", help="Write the fields of ROS's sensor_msgs/MagneticField: tesla, and a covariance."),
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="Replace an existing file.")] = False,
) -> None:
    """Correct a recording with a calibration or a model, and keep the recording's other columns.

    For a magnetometer, the columns field_x, field_y and field_z are added: the corrected field of each row. For your
    own simulation, or a simulator's output, a column NAME_simulated is added for each output, simulated with the
    findings, and the RMSE of the measured column is printed; no measured column is replaced. Findings that belong to
    the time or place of the diagnosed recording are not applied.
    """
    names, units = parsed_columns(columns), parsed_units(convert or [], unit_label)
    if simulation is not None and simulator_output is not None:
        raise typer.BadParameter("--simulation and --simulator-output exclude each other; give the diagnosed one.")
    refuse_no_text(model)
    refuse_unreadable(recording, names, sensor, magnetometer=False)
    with loading():
        from mkc_torch.cli.applied_unit import corrected_in_its_unit
        from mkc_torch.cli.correction import (
            correct,
            correct_as_messages,
            read_correction,
            show_correction,
            with_sizes_of,
            write_correction,
        )
        from mkc_torch.cli.diagnosis_files import named_simulation, paired_simulation
        from mkc_torch.cli.recorded import read_again
        from mkc_torch.simulation.load import raised_in
    subject: str | Path = model
    try:
        with interrupts_reported(lambda: f"nothing was written to {output}."), progress(1, lines=True) as step:
            step(f"correcting {recording.name}")
            own = None
            if simulation is not None or simulator_output is not None:
                subject = str(simulation or simulator_output)
                own = named_simulation(simulation) if simulation else paired_simulation(Path(subject), names)
            subject = model
            known = with_sizes_of(read_correction(model, own), sizes_of)
            subject = output
            _refuse_input(output, recording, model, simulator_output)
            subject = recording
            read = read_again(recording, names, units, sensor, recognise=own is None)
            table = read.recording
            correcting = partial(correct_as_messages if ros else correct, known)
            corrected = corrected_in_its_unit(recording, read, known, correcting) if own is None else correcting(table)
            subject = output
            corrected = write_correction(recording, output, read, corrected, force=force)
    except Exception as error:
        in_simulation = raised_in(simulation, error) if simulation and simulation not in SIMULATIONS else None
        if in_simulation is None and not isinstance(error, FAILURES):
            raise
        complain(subject, in_simulation or error)
        raise typer.Exit(1) from None
    show_correction(table, corrected, output)


def _refuse_input(output: Path, *inputs: Path | None) -> None:
    """Raise if the output file is one of the input files, also under another name.

    Raises:
        ValueError: the output is an input.
    """
    for path in inputs:
        if path is not None and output.exists() and path.exists() and output.samefile(path):
            raise ValueError(f"--output is the input file {path}; choose another.")
