"""Hidden physics in recordings of real magnetometers: the diagnosis, and the step by the true attitude.

Data:
    broad: Laidig et al., "BROAD - A Benchmark for Robust Inertial Orientation Estimation", Data 6(7):72 (2021),
        github.com/dlaidig/broad, CC BY 4.0.
    full_sphere: github.com/sunsided/sensor-fusion, EUPL-1.2.
    raw_counts: github.com/tomisuarez2/MagnetometerCalibration, MIT.
    quadrotor: github.com/dronekit/dronekit-la-testdata, CC BY-SA 3.0.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from mkc_torch import Diagnosis, Recording, diagnose
from mkc_torch.diagnosis.result import Finding
from mkc_torch.simulation import Magnetometer

DATA = Path(__file__).resolve().parents[3].parent / "shared" / "data" / "magnetometer"
"""Default folder of the recordings, next to the project's folder."""

FIELD = ("mag_x", "mag_y", "mag_z")
QUATERNION = ("q_x", "q_y", "q_z", "q_w")  # in SciPy's order
SHOWN = "broad_34_attached_magnet_3cm"


@dataclass(frozen=True)
class Case:
    """A recording, its view, and the interval in which a magnet is taken off, if any."""

    name: str
    use: str = "norm"
    every: int = 1
    unit: str = "µT"
    field_alone: bool = False
    taken_off: tuple[float, float] | None = None

    def recording(self, folder: Path) -> Recording:
        whole = Recording.read(folder / f"{self.name}.csv")
        names = [name for name in whole.columns if not self.field_alone or name in ("time", *FIELD)]
        columns = {name: whole[name][:: self.every] for name in names}
        return Recording(columns, name=self.name, units=dict.fromkeys(FIELD, self.unit))


CASES = (
    Case("broad_34_attached_magnet_3cm", every=4, field_alone=True, taken_off=(48.0, 54.0)),
    Case("broad_36_attached_magnet_5cm", every=4, field_alone=True, taken_off=(51.0, 57.0)),
    Case("broad_21_undisturbed_fast", every=4),
    Case("broad_21_undisturbed_fast", "attitude", every=4),
    Case("broad_02_undisturbed", every=4),
    Case("full_sphere"),
    Case("raw_counts", every=4, unit="counts"),
    Case("quadrotor_compass1", "attitude"),
    Case("quadrotor_compass3", "attitude"),
)


def step_by_attitude(folder: Path, case: Case) -> npt.NDArray[np.float64]:
    """Return the step of the offset when a magnet is taken off, from the true attitude by least squares.

    The model is a constant field in sensor axes and an offset for each part; only the reader is of this library.
    """
    assert case.taken_off is not None
    whole = Recording.read(folder / f"{case.name}.csv")
    moment, measured, attitude = whole["time"].numpy(), whole.stack(*FIELD).numpy(), whole.stack(*QUATERNION).numpy()
    before, after = moment < case.taken_off[0], moment > case.taken_off[1]
    taken = (before | after) & np.isfinite(np.concatenate([measured, attitude], -1)).all(-1)
    to_sensor = Rotation.from_quat(attitude[taken]).inv().as_matrix()
    offsets = np.stack([before, after], -1)[taken][:, None, :, None] * np.eye(3)[None, :, None, :]
    design = np.concatenate([to_sensor, offsets.reshape(-1, 3, 6)], -1)
    solution = np.linalg.lstsq(design.reshape(-1, 9), measured[taken].reshape(-1), rcond=None)[0]
    return solution[6:] - solution[3:6]


def finding_line(finding: Finding) -> str:
    """Return a line on a finding: effect, time, size, and its gain on held-out blocks."""
    moment = "" if finding.onset is None else f" at {finding.onset:.1f} s"
    drivers = f" by {', '.join(finding.drivers)}" if finding.drivers else ""
    size = finding.parameters[0]
    value, error = (
        ", ".join(f"{v:.3g}" for v in np.ravel(np.array(numbers, dtype=float)).tolist())
        for numbers in (size.value, size.standard_error)
    )
    held = finding.held_out
    gain = "" if held is None else f"; residual {held.rmse_before:.3g} -> {held.rmse_after:.3g} {held.unit}"
    return f"  {finding.effect}{drivers}{moment}: {size.name} ({value}) ± ({error}) {size.unit}{gain}"


def picture(diagnosis: Diagnosis, path: Path) -> None:
    """Draw the residual over time before and after, with the onset."""
    t = diagnosis.traces
    figure, axes = plt.subplots(2, 1, figsize=(9, 5), sharex=True, sharey=True, layout="constrained")
    for ax, residual, words in zip(axes, (t.before, t.after), ("one ellipsoid", "with what was found"), strict=True):
        ax.plot(t.time, residual[:, 0], ".", color="tab:blue", markersize=2)
        ax.set_title(words, loc="left")
        ax.set_ylabel(f"residual, {t.unit}")
        for finding in diagnosis.findings:
            if finding.onset is not None:
                ax.axvline(finding.onset, color="tab:red", linewidth=1)
    axes[1].set_xlabel("time, s")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=DATA, help="folder with the magnetometers' recordings")
    parser.add_argument("--output", type=Path, help=f"PNG file to write of {SHOWN}")
    options = parser.parse_args()
    for case in CASES:
        start = time.perf_counter()
        diagnosis = diagnose(Magnetometer(case.use), case.recording(options.data))
        print(f"{case.name}, {case.use}: {diagnosis.verdict}, {time.perf_counter() - start:.0f} s")
        for finding in diagnosis.findings:
            print(finding_line(finding))
        if case.taken_off is not None:
            print(f"  by the true attitude: {np.round(step_by_attitude(options.data, case), 2).tolist()} µT")
        if options.output and case.name == SHOWN:
            picture(diagnosis, options.output)


if __name__ == "__main__":
    main()
