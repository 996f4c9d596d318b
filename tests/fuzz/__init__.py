"""Fuzzing, which is run by hand: `python -m tests.fuzz.readers` and `python -m tests.fuzz.diagnoses`."""
