"""The classical method of fourth order, step by step: a reference that is independent of collocation."""

from itertools import pairwise

import numpy as np


def runge_kutta(rate, first, time, parts=20):
    """States at the times, (N, n), of ``rate(t, y)``; with ``parts`` steps an interval."""
    states = [np.asarray(first, dtype=float)]
    for early, late in pairwise(time):
        y, h = states[-1], (late - early) / parts
        for t in early + h * np.arange(parts):
            a = np.asarray(rate(t, y))
            b = np.asarray(rate(t + h / 2, y + h / 2 * a))
            c = np.asarray(rate(t + h / 2, y + h / 2 * b))
            d = np.asarray(rate(t + h, y + h * c))
            y = y + h / 6 * (a + 2 * b + 2 * c + d)
        states.append(y)
    return np.stack(states)
