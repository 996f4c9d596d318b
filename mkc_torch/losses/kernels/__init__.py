"""Triton kernels of the losses; imported where a batch lies on a GPU, or where the interpreter is asked for.

``formulas`` has what the kernels compute of an element, ``channels`` the running state and the numbers of each channel,
``elements`` the pass over a batch; ``operators`` puts them behind ``torch.library``, and ``loss`` is what
:class:`mkc_torch.MKCLoss` calls. In the same way :class:`mkc_torch.HeteroscedasticMKCLoss` calls ``sample_loss``, with
the kernel in ``samples`` and its ``sample_operators``, and :class:`mkc_torch.GeneralizedCrossEntropyLoss` calls
``label_loss``, with ``labels`` and ``label_operators``.
"""
