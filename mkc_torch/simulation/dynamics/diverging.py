"""Whether a simulation with the user's own values stays finite, and where not."""

from __future__ import annotations

from mkc_torch.simulation.dynamics.prepared import PreparedDynamics
from mkc_torch.simulation.dynamics.rollout import free_steps
from mkc_torch.simulation.start_checks import StartCheck


def divergence_checks(prepared: PreparedDynamics) -> tuple[StartCheck, ...]:
    """Return a check if the free run with the given values is not finite; of steps it has the state and the time.

    Args:
        prepared: the simulation; the initial states of a run are those of the first guess.
    """
    free, steps = prepared.observed(None), prepared.system.steps
    if steps is None:
        lost = ~free.residual(prepared.given, {}).isfinite().all(0)
        names = prepared.channels
        cause = "Check signs and units of the values."
        where = ""
    else:
        states = free_steps(free, prepared.given, {}, free.first_states(prepared.given, {})[0])
        if states is None:
            return ()
        wrong = ~states.isfinite()
        first = int(wrong.any(-1).long().argmax())
        lost = wrong[first]
        names = prepared.system.states
        where = f" from {float(prepared.grid.time[first] - prepared.time[0]):.4g} s on"
        cause = f"The time step, {steps.size:.4g} s, may be too long for the stiffness; check also units of the values."
    if not bool(lost.any()):
        return ()
    name = names[int(lost.long().argmax())]
    text = f"With the given values, the free run of `{name}` is not finite{where}. {cause}"
    return (StartCheck("diverges", (name,), text),)
