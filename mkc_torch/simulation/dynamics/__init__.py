"""Differential equations: how a user writes them, their trajectories, and the ports through which effects act."""

from mkc_torch.simulation.dynamics.definition import Dynamics

__all__ = ["Dynamics"]
