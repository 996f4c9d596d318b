"""``mkc effects``: list the effects of the catalogue, and where each can act in a simulation."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mkc_torch.cli.console import FAILURES, complain, err, out
from mkc_torch.cli.diagnosis_request import SIMULATIONS, Request, is_file_of_a_simulation
from mkc_torch.cli.loading import loading
from mkc_torch.cli.simulation_option import (
    COLUMNS_HELP,
    COLUMNS_METAVAR,
    OWN_SIMULATION,
    RUN_COLUMN_HELP,
    checked_columns,
    checked_sensor,
    checked_simulation,
    checked_units,
)
from mkc_torch.cli.units_option import CONVERT_HELP, CONVERT_METAVAR, LABEL_HELP, SENSOR_HELP

if TYPE_CHECKING:
    from mkc_torch.cli.effects_summary import EffectsSummary


def effects(
    recording: Annotated[
        Path | None,
        typer.Argument(metavar="REC", show_default=False, help="A recording of the simulated system."),
    ] = None,
    simulation: Annotated[
        str | None, typer.Option(metavar="NAME", help=f"Simulation: {', '.join(SIMULATIONS)}, {OWN_SIMULATION}")
    ] = None,
    simulator_output: Annotated[
        Path | None, typer.Option(metavar="SIM.csv", help="Instead of --simulation: a simulator's output for REC.")
    ] = None,
    columns: Annotated[str | None, typer.Option(metavar=COLUMNS_METAVAR, help=COLUMNS_HELP)] = None,
    convert: Annotated[list[str] | None, typer.Option(metavar=CONVERT_METAVAR, help=CONVERT_HELP)] = None,
    unit_label: Annotated[str | None, typer.Option(metavar="UNIT", help=LABEL_HELP)] = None,
    sensor: Annotated[str | None, typer.Option(metavar="NAME", help=SENSOR_HELP)] = None,
    run_column: Annotated[str | None, typer.Option(metavar="COLUMN", help=RUN_COLUMN_HELP)] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")] = False,
) -> None:
    """List the effects that `mkc diagnose` knows; with --simulation, where each can act there.

    The places are written EFFECT@PORT(DRIVER). Without REC they are all that the states, inputs and outputs of the
    simulation allow; with REC they are those that a diagnosis of REC tries. The exit code is 0 if the effects were
    listed, and 1 otherwise.
    """
    if recording is None and (convert or unit_label or sensor or run_column):
        raise typer.BadParameter("--convert, --unit-label, --sensor and --run-column describe a recording; give REC.")
    request = Request(
        simulation=checked_simulation(simulation, simulator_output),
        simulator_output=simulator_output,
        columns=checked_columns(columns, run_column),
        units=checked_units(convert or [], unit_label, simulation),
        sensor=checked_sensor(sensor, simulation),
    )
    with loading():
        from mkc_torch.cli.effects_summary import as_data, show
    summary = _summary(recording, request)
    if as_json:
        typer.echo(json.dumps(as_data(summary), ensure_ascii=False, indent=2, allow_nan=False))
    else:
        show(out(), summary)


def _summary(path: Path | None, request: Request) -> EffectsSummary:
    """Return the list; exit with one message if the recording or the simulation cannot be used."""
    from mkc_torch.cli.diagnosis_files import decided, read_recording, simulation_of
    from mkc_torch.cli.effects_summary import declared_places, recorded_places, whole_catalogue
    from mkc_torch.simulation.load import raised_in

    if path is None and request.undecided:
        return whole_catalogue()
    subject = path or request.simulator_output or request.simulation
    try:
        if path is None:
            return declared_places(simulation_of(request))
        request, note = decided(path, request)
        if note:
            err().print(f"mkc: {note}", soft_wrap=True)
        return recorded_places(simulation_of(request), read_recording(path, request))
    except Exception as error:
        own = raised_in(request.simulation, error) if is_file_of_a_simulation(request.simulation) else None
        if own is None and not isinstance(error, FAILURES):
            raise
        complain(subject, own or error)
        raise typer.Exit(1) from None
