"""Benchmarks: times are measured and not tested, for they differ from machine to machine."""
