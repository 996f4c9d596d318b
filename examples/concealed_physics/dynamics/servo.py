"""A servo with a pendulum, simulated with viscous friction alone: found at two controller gains, proven at two others.

Data: Duclusaud et al., "Extended Friction Models for the Physics Simulation of Servo Actuators", ICRA 2025,
arXiv:2410.08650, github.com/Rhoban/bam, Apache-2.0.
"""

from __future__ import annotations

from held_out import arguments, finding_text, picture, prove
from systems import servo


def main() -> None:
    options = arguments(__doc__.splitlines()[0])
    case = servo(options.data)
    (proof,) = prove(case.system, case.train, list(case.tests.values()), max_findings=1)
    before, after = proof.mean_absolute()
    print(f"{finding_text(proof.diagnosis)}\nopen loop at the other gains: {before:.3f} -> {after:.3f} rad")
    if options.output:
        picture(proof, options.output, "The first runs at another gain", "angle", "rad", slice(0, 400))


if __name__ == "__main__":
    main()
