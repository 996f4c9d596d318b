"""``mkc export``: write a calibration or a model in the format of an autopilot or a program."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mkc_torch.cli.console import FAILURES, complain, out
from mkc_torch.cli.early import refuse_no_text
from mkc_torch.cli.export_options import DEVICE_ID, INSTANCE, checked_exports
from mkc_torch.cli.loading import loading


def export(
    model: Annotated[
        Path,
        typer.Argument(metavar="MODEL.json", help="calibration.json of `mkc calibrate`, model.json of `mkc diagnose`."),
    ],
    to: Annotated[str, typer.Option(metavar="KIND", help="px4, ardupilot, c-header, ros-yaml, imu-calib or json.")],
    output: Annotated[Path, typer.Option(help="File to write.")],
    name: Annotated[
        str | None,
        typer.Option(help="Name of the sensor; default: that of the calibration, or of the model's folder."),
    ] = None,
    instance: INSTANCE = None,
    device_id: DEVICE_ID = None,
    force: Annotated[bool, typer.Option("--force", help="Replace an existing file.")] = False,
) -> None:
    """Export a calibration as PX4 or ArduPilot parameters, C header, ROS parameter file, or JSON.

    imu-calib is for accelerometers, the others are for magnetometers.

    From a model, the offset, the matrix and the field of a current are exported; a warning names other findings.
    """
    if name is not None and not name.strip():
        raise typer.BadParameter("--name is empty; name the sensor, such as mast.")
    checked_exports("--to", [to], instance, device_id)
    refuse_no_text(model)
    with loading():
        from mkc_torch._support.files import write_atomically
        from mkc_torch.calibration.exports import EXPORTS, Destination
        from mkc_torch.cli.correction import read_correction
        from mkc_torch.cli.exported import correction_of
    subject = model
    try:
        correction = correction_of(read_correction(model), model, name)
        kind = EXPORTS[to]
        exported = kind.text(correction, Destination(instance, device_id))
        subject = output
        if output.exists() and output.samefile(model):
            raise ValueError(f"--output is the input file {model}; choose another.")
        write_atomically(output, exported.text, overwrite=force)
    except FAILURES as error:
        complain(subject, error)
        raise typer.Exit(1) from None
    console = out()
    for warning in exported.warnings:
        console.print(f"warning: {warning}", soft_wrap=True)
    console.print(f"{correction.name} for {to}, to load {kind.load}: {output}", soft_wrap=True)
