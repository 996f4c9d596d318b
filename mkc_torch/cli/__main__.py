"""``python -m mkc_torch.cli``: the same as ``mkc``."""

from mkc_torch.cli import main

main()
