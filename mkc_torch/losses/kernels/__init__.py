"""Triton kernels of the losses; imported where a batch lies on a GPU, or where the interpreter is asked for.

``formulas`` has what the kernels compute of an element, ``channels`` the running state and the numbers of each channel,
``elements`` the pass over a batch; ``operators`` puts them behind ``torch.library``, and ``loss`` is what
:class:`mkc_torch.MKCLoss` calls.
"""
