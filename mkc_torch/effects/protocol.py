"""The former module of :func:`lagged`, for generated files that import it; it is in :mod:`mkc_torch.effects`."""

from mkc_torch.effects.waveforms import lagged

__all__ = ["lagged"]
