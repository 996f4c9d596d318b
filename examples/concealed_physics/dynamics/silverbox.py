"""An electronic oscillator, simulated as a linear one: found on a part of a multisine, proven on others.

Data: Wigren & Schoukens, "Three free data sets for development and benchmarking in nonlinear system identification",
European Control Conference 2013.
"""

from __future__ import annotations

from held_out import arguments, picture, prove, told

from mkc_torch import Recording
from mkc_torch.simulation import Dynamics, Parameter

TRAIN, ROWS = 45_000, 8_192
TESTS = {"multisine": (100_000, 8_192), "arrow": (0, 40_000)}
"""First row and number of rows."""


class Silverbox(Dynamics):
    """A linear resonator, driven with an offset."""

    states = ("output", "speed")
    inputs = ("input",)
    between = "smooth"
    starts_from = 0.1
    parameters = {
        "stiffness": Parameter(1.8e5, lower=0.0, unit="1/s²"),
        "damping": Parameter(20.0, lower=0.0, unit="1/s"),
        "gain": 1e5,
        "offset": 0.0,
    }

    def derivative(self, time, x, u, p):
        return {
            "output": x.speed,
            "speed": p.gain * (u.input + p.offset) - p.stiffness * x.output - p.damping * x.speed,
        }


def main() -> None:
    options = arguments(__doc__.splitlines()[0])
    table = Recording.read(options.data / "silverbox" / "silverbox.csv")

    def rows(first: int, count: int) -> Recording:
        return Recording({name: table[name][first : first + count] for name in table.names})

    proofs = prove(Silverbox(), rows(TRAIN, ROWS), [rows(*test) for test in TESTS.values()], max_findings=1)
    print(told(proofs[0].diagnosis))
    for name, proof in zip(TESTS, proofs, strict=True):
        before, after = proof.root_mean_square(proof.time - proof.time[0] > Silverbox.starts_from)
        print(f"free run on {len(proof.time)} samples of the {name}: {1e3 * before:.2f} -> {1e3 * after:.3f} mV")
    if options.output:
        picture(proofs[0], options.output, "Free run on a multisine that the fit has not seen", "V", slice(1000, 1200))


if __name__ == "__main__":
    main()
