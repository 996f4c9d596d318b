"""Calibrate a sensor that hardly tilts with the aid of a gyroscope, an attitude, or place and date."""
