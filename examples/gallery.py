"""The manual's pictures of real magnetometers: the recordings and their calibrations.

    python examples/gallery.py --data ../shared/data/magnetometer --output docs/pictures

Data:
    broad: Laidig et al., "BROAD - A Benchmark for Robust Inertial Orientation Estimation", Data 6(7):72 (2021),
        github.com/dlaidig/broad, CC BY 4.0.
    raw_counts: github.com/tomisuarez2/MagnetometerCalibration, MIT.
    quadrotor: github.com/dronekit/dronekit-la-testdata, CC BY-SA 3.0.
"""

from __future__ import annotations

import argparse
import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

from matplotlib import pyplot
from matplotlib.figure import Figure
from PIL import Image

from mkc_torch import Recording, diagnose
from mkc_torch.calibration import calibrate
from mkc_torch.simulation import Magnetometer

FIELD = ("mag_x", "mag_y", "mag_z")
SIZE, DPI, COLORS = (9.0, 3.6), 90, 48  # inches, dots an inch: small enough for the repository


def read(folder: Path, name: str, *, every: int = 1, unit: str = "µT", field_alone: bool = False) -> Recording:
    """Read every n-th row of a recording, with all columns or the field only."""
    whole = Recording.read(folder / f"{name}.csv")
    names = [name for name in whole.names if not field_alone or name in ("time", *FIELD)]
    columns = {name: whole[name][::every] for name in names}
    return Recording(columns, name=name, units=dict.fromkeys(FIELD, unit))


def passing_magnet(folder: Path, left: Any, right: Any) -> None:
    """The board passes a magnet that lies in the room."""
    calibration = calibrate(read(folder, "broad_28_stationary_magnet", field_alone=True))
    calibration.plot.sphere("xz", ax=left)
    calibration.plot.residual(ax=right)


def attached_magnet(folder: Path, left: Any, right: Any) -> None:
    """A magnet sits on the board and is taken off."""
    recording = read(folder, "broad_34_attached_magnet_3cm", every=4, field_alone=True)
    diagnosis = diagnose(Magnetometer("norm"), recording)
    diagnosis.plot.residual(corrected=False, ax=left)
    diagnosis.plot.residual(corrected=True, ax=right)
    right.set_ylim(left.get_ylim())


def raw_counts(folder: Path, left: Any, right: Any) -> None:
    """A sensor in raw counts whose axes have gains of 2.2 to 1."""
    calibration = calibrate(read(folder, "raw_counts", unit="counts"))
    calibration.plot.sphere("xy", ax=left)
    calibration.plot.sphere("xy", corrected=True, ax=right)


def quadrotor(folder: Path, left: Any, right: Any) -> None:
    """The third compass of a flying quadrotor, next to the wires of its battery."""
    diagnosis = diagnose(Magnetometer("attitude"), read(folder, "quadrotor_compass3"))
    diagnosis.plot.effect(0, ax=left)
    diagnosis.plot.held_out(ax=right)


def save(figure: Figure, path: Path) -> None:
    """Save as a PNG of few colours, which halves the file."""
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=DPI)
    pyplot.close(figure)
    Image.open(buffer).convert("P", palette=Image.Palette.ADAPTIVE, colors=COLORS).save(path, optimize=True)


PICTURES: dict[str, Callable[[Path, Any, Any], None]] = {
    picture.__name__: picture for picture in (passing_magnet, attached_magnet, raw_counts, quadrotor)
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="folder with the magnetometers' recordings")
    parser.add_argument("--output", type=Path, required=True, help="folder for the PNG files")
    parser.add_argument("--only", nargs="*", default=list(PICTURES), choices=list(PICTURES))
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    for name in options.only:
        figure, (left, right) = pyplot.subplots(1, 2, figsize=SIZE, layout="constrained")
        PICTURES[name](options.data, left, right)
        save(figure, options.output / f"{name}.png")
        print(options.output / f"{name}.png")


if __name__ == "__main__":
    main()
