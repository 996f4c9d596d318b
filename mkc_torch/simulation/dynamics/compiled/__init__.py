"""Differential equations as lists of NumPy operations: traced once, differentiated by rules, solved without torch."""
