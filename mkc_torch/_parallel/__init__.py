"""Parallel work on the cores of one machine."""
