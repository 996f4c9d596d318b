"""Differential equations as NumPy operations: traced once, differentiated symbolically, solved without torch."""
