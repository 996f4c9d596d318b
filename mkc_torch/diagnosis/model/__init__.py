"""A simulation with effects in it: terms, the grid of candidates, joint fits."""
