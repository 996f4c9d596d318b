"""An electronic oscillator, simulated as a linear one: found on a part of a multisine, proven on others.

Data: Wigren & Schoukens, "Three free data sets for development and benchmarking in nonlinear system identification",
European Control Conference 2013.
"""

from __future__ import annotations

from held_out import arguments, finding_text, picture, prove
from systems import silverbox


def main() -> None:
    options = arguments(__doc__.splitlines()[0])
    case = silverbox(options.data)
    proofs = prove(case.system, case.train, list(case.tests.values()), max_findings=1)
    print(finding_text(proofs[0].diagnosis))
    for name, proof in zip(case.tests, proofs, strict=True):
        before, after = proof.root_mean_square(proof.time - proof.time[0] > case.scored_from)
        print(f"free run on {len(proof.time)} samples of the {name}: {1e3 * before:.2f} -> {1e3 * after:.3f} mV")
    if options.output:
        picture(proofs[0], options.output, "Open loop on another multisine", "voltage", "V", slice(1000, 1200))


if __name__ == "__main__":
    main()
