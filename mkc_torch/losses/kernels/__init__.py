"""Triton kernels of the losses; imported for batches on a GPU, or with ``impl="triton"``.

``entry`` is called by the losses. For :class:`mkc_torch.MKCLoss`, ``formulas`` computes an element, ``channels`` the
running state and the numbers of each channel, ``elements`` the pass over a batch; ``loss`` has the autograd functions
and ``operators`` the operators of ``torch.library``. :class:`mkc_torch.HeteroscedasticMKCLoss` has the kernel
``samples`` with ``sample_loss`` and ``sample_operators``, :class:`mkc_torch.GeneralizedCrossEntropyLoss` the kernel
``labels`` with ``label_loss`` and ``label_operators``.
"""
