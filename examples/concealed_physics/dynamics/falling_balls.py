"""Balls dropped from a bridge, simulated without air: what is missing is found on one drop and proven on another.

Data: de Silva et al., "Discovery of Physics from Data: Universal Laws and Discrepancies", Frontiers in AI 3:25 (2020).
"""

from __future__ import annotations

import torch
from held_out import arguments, picture, prove, told

from mkc_torch import Recording
from mkc_torch.simulation import Dynamics


class Ball(Dynamics):
    """A ball in free fall."""

    states = ("height", "speed")
    units = {"height": "m", "speed": "m/s"}
    starts_from = 1.0

    def derivative(self, time, x, u, p):
        return {"height": x.speed, "speed": torch.full_like(x.speed, -9.81)}


def main() -> None:
    options = arguments(__doc__.splitlines()[0])
    drops = Recording.read(options.data / "falling_balls" / "ball_drops.csv").experiments()
    errors = []
    for name in (name for name in drops if name.endswith("/1")):
        ball = name.removesuffix("/1")
        one, other = (
            Recording({"time": drop["time"], "height": drop["height"]}, name=ball)
            for drop in (drops[name], drops[f"{ball}/2"])
        )
        (proof,) = prove(Ball(), one, [other], max_findings=1)
        unseen = proof.time - proof.time[0] > 1.0
        before, after = proof.mean_absolute(unseen)
        errors.append((before, after))
        print(f"{ball:20s} {told(proof.diagnosis):60s} other drop {before:6.2f} -> {after:5.2f} m")
        if options.output and ball == "Whiffle_Ball_1":
            picture(proof, options.output, "A whiffle ball's second drop, predicted from its first second", "m")
    before, after = torch.tensor(errors).mean(0).tolist()
    print(f"mean over {len(errors)} balls: {before:.2f} -> {after:.2f} m")


if __name__ == "__main__":
    main()
