"""Loops over samples in plain Python, compiled by Numba where it is installed.

Each loop has an equivalent in NumPy for use without Numba; both agree to rounding.
"""
