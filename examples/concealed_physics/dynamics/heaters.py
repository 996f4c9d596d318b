"""Two heaters on one board, simulated each by itself: what is missing is found on one run and proven on another.

Data: Hedengren, "Temperature Control Lab", github.com/APMonitor/arduino, Apache-2.0.
"""

from __future__ import annotations

from held_out import arguments, picture, prove, told

from mkc_torch import Recording
from mkc_torch.simulation import Dynamics, Parameter


class Heaters(Dynamics):
    """Each heater warms its own sensor, which cools to the room."""

    states = ("temperature_1", "temperature_2")
    inputs = ("heater_1", "heater_2")
    units = {"temperature_1": "°C", "temperature_2": "°C"}
    between = "held"
    parameters = {
        "loss_1": Parameter(0.01, lower=0.0, unit="1/s"),
        "loss_2": Parameter(0.01, lower=0.0, unit="1/s"),
        "gain_1": Parameter(0.01, lower=0.0),
        "gain_2": Parameter(0.005, lower=0.0),
        "room": Parameter(20.0, unit="°C"),
    }

    def derivative(self, time, x, u, p):
        return {
            "temperature_1": p.loss_1 * (p.room - x.temperature_1) + p.gain_1 * u.heater_1,
            "temperature_2": p.loss_2 * (p.room - x.temperature_2) + p.gain_2 * u.heater_2,
        }


def main() -> None:
    options = arguments(__doc__.splitlines()[0])
    folder = options.data / "heaters"
    (proof,) = prove(Heaters(), Recording.read(folder / "run_1s.csv"), [Recording.read(folder / "run_3s.csv")])
    before, after = proof.root_mean_square()
    print(f"{told(proof.diagnosis)}\nother run: {before:.2f} -> {after:.2f} °C")
    if options.output:
        picture(proof, options.output, "The other run of the heaters, first sensor", "°C")


if __name__ == "__main__":
    main()
