"""Two heaters on one board, simulated each by itself: what is missing is found on one run and proven on another.

Data: Hedengren, "Temperature Control Lab", github.com/APMonitor/arduino, Apache-2.0.
"""

from __future__ import annotations

from held_out import arguments, finding_text, picture, prove
from systems import heaters


def main() -> None:
    options = arguments(__doc__.splitlines()[0])
    case = heaters(options.data)
    (proof,) = prove(case.system, case.train, list(case.tests.values()))
    before, after = proof.root_mean_square()
    print(f"{finding_text(proof.diagnosis)}\nother run: {before:.2f} -> {after:.2f} °C")
    if options.output:
        picture(proof, options.output, "The other run of the heaters, first sensor", "temperature", "°C")


if __name__ == "__main__":
    main()
