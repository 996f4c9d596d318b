"""Simulations by differential equations: their definition, their trajectories, and the ports where effects act."""

from mkc_torch.simulation.dynamics.definition import Dynamics

__all__ = ["Dynamics"]
