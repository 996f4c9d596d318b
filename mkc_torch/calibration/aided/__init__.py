"""Calibration of a sensor that hardly tilts: with a gyroscope, an attitude, or place and date."""
