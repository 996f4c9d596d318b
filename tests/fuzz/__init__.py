"""Fuzzing, which is run by hand: `python -m tests.fuzz.readers --minutes 60`."""
