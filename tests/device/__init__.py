"""Checks of the library on a GPU or any other device of torch: ``python -m tests.device``."""
