"""What a GPU, or any other device of torch, makes of the library: ``python -m tests.device``."""
