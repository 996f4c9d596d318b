"""A simulation with effects: terms, the grid of candidates, joint fits."""
