"""Settings of Newton's method on a trajectory."""

from __future__ import annotations

__all__ = ["HALVINGS", "HORIZON", "MOST_STEPS", "QUICK", "ROUGHLY", "ROUNDING", "SETTLED", "STALLED"]

MOST_STEPS = 30
"""Steps at most."""

STALLED = 5
"""Steps after which the defects must have halved."""

SETTLED = 1e-9
"""Largest change, as a share of each state's size, at which the equations are solved."""

HALVINGS = 6
"""Halvings of a step at most."""

QUICK = 0.01
"""Largest share of the defects that a step with the linearised equations of a trajectory nearby may leave."""

ROUNDING = 1e-6
"""Change, as a share of each state's size, below which defects that no longer shrink are of rounding."""

HORIZON = 32
"""Moments by which the horizon of a guess grows that is found step by step."""

ROUGHLY = 1e-4
"""Change, as a share of each state's size, at which such a guess is good enough for its horizon to grow."""
