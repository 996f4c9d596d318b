"""Helpers without domain knowledge: argument checks, files, order statistics, trust regions, forward mode, units."""
