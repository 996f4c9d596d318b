"""Loops over samples in plain Python, compiled by Numba where it is installed.

Each has a counterpart in NumPy that serves where Numba is absent and gives the same numbers to rounding.
"""
