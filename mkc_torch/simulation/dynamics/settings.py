"""Settings of Newton's method for trajectories."""

from __future__ import annotations

MOST_STEPS = 30
"""Newton steps at most."""

STALLED = 5
"""Newton steps within which the defects must halve."""

SETTLED = 1e-9
"""Largest change, as a share of each state's size, at which Newton's method has converged."""

HALVINGS = 6
"""Halvings of a step at most."""

QUICK = 0.01
"""Largest remaining share of the defects after a step with the linearisation of a trajectory nearby."""

QUICK_MAP = 0.3
"""The same for a simulation that steps, whose derivatives are differences of many steps."""

ROUNDING = 1e-6
"""Change, as a share of each state's size, below which defects that no longer shrink are rounding errors."""

HORIZON = 32
"""Grid times by which the horizon grows when a guess is solved over growing horizons."""

ROUGHLY = 1e-4
"""Change, as a share of each state's size, at which such a guess has converged and its horizon grows."""
