"""Figures of a diagnosis, each on axes of matplotlib; the report uses the same functions."""
