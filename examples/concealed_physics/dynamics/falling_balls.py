"""Balls dropped from a bridge, simulated without air: what is missing is found on one drop and proven on another.

Data: de Silva et al., "Discovery of Physics from Data: Universal Laws and Discrepancies", Frontiers in AI 3:25 (2020).
"""

from __future__ import annotations

import torch
from held_out import arguments, finding_text, picture, prove
from systems import Ball, balls

__all__ = ["Ball"]


def main() -> None:
    options = arguments(__doc__.splitlines()[0])
    errors = []
    for case in balls(options.data):
        (proof,) = prove(case.system, case.train, list(case.tests.values()), max_findings=1)
        before, after = proof.mean_absolute(proof.time - proof.time[0] > case.scored_from)
        errors.append((before, after))
        print(f"{case.name:20s} {finding_text(proof.diagnosis):60s} other drop {before:6.2f} -> {after:5.2f} m")
        if options.output and case.name == "Whiffle_Ball_1":
            picture(
                proof, options.output, "A whiffle ball's second drop, predicted from its first second", "height", "m"
            )
    before, after = torch.tensor(errors).mean(0).tolist()
    print(f"mean over {len(errors)} balls: {before:.2f} -> {after:.2f} m")


if __name__ == "__main__":
    main()
