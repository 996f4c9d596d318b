"""MKC-EM callback for Lightning: the optimiser trains the network, EM fits sigma and d of the loss."""

from importlib.util import find_spec

if find_spec("lightning") is None:
    raise ModuleNotFoundError("mkc_torch.lightning needs Lightning: pip install 'mkc-torch[lightning]'")

from mkc_torch.lightning._owned import SIGMA_CAP
from mkc_torch.lightning.callback import MKCExpectationMaximization

__all__ = ["SIGMA_CAP", "MKCExpectationMaximization"]
