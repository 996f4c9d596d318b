"""Noise of residuals: its colour, gaps, bursts, what is rejected."""
