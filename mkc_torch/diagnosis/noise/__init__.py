"""Noise of the residuals: its spectrum, rejected samples, bursts and imputation."""
