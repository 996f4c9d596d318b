"""Where files that were written for users look for :func:`lagged`; today it is in :mod:`mkc_torch.effects`."""

from mkc_torch.effects.courses import lagged

__all__ = ["lagged"]
