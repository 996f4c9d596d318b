"""Published data sets and reference values of robust regression, as plain data.

Values of R are from robustbase 0.99-6; the others were computed independently in float64 (exhaustive subsets, an exact
linear program, quadrature in many digits) and agree with R where it prints them. Coefficients: the intercept first.
They hold to a relative 1e-5 unless a comment states another.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

# Brownlee (1965), oxidation of ammonia: air flow, water temperature, acid concentration; stack loss.
_STACKLOSS = """
80 27 89 42
80 27 88 37
75 25 90 37
62 24 87 28
62 22 87 18
62 23 87 18
62 24 93 19
62 24 93 20
58 23 87 15
58 18 80 14
58 18 89 14
58 17 88 13
58 18 82 11
58 19 93 12
50 18 89 8
50 18 86 7
50 19 72 8
50 19 79 8
50 20 80 9
56 20 82 15
70 20 91 15
"""

# Rousseeuw and Leroy (1987), star cluster CYG OB1: log temperature; log light. Rows 11, 20, 30, 34 are giants.
_STARS_CYG = """
4.37 5.23
4.56 5.74
4.26 4.93
4.56 5.74
4.3 5.19
4.46 5.46
3.84 4.65
4.57 5.27
4.26 5.57
4.37 5.12
3.49 5.73
4.43 5.45
4.48 5.42
4.01 4.05
4.29 4.26
4.42 4.58
4.23 3.94
4.42 4.18
4.23 4.18
3.49 5.89
4.29 4.38
4.29 4.22
4.42 4.42
4.49 4.85
4.38 5.02
4.42 4.66
4.29 4.66
4.38 4.9
4.22 4.39
3.48 6.05
4.38 4.42
4.56 5.1
4.45 5.22
3.49 6.29
4.23 4.34
4.62 5.62
4.53 5.1
4.45 5.22
4.53 5.18
4.43 5.57
4.38 4.62
4.45 5.06
4.5 5.34
4.45 5.34
4.55 5.54
4.45 4.98
4.42 4.5
"""

# Hawkins, Bradu and Kass (1984), constructed: rows 1 to 10 are bad leverage points, 11 to 14 good ones.
_HBK = """
10.1 19.6 28.3 9.7
9.5 20.5 28.9 10.1
10.7 20.2 31 10.3
9.9 21.5 31.7 9.5
10.3 21.1 31.1 10
10.8 20.4 29.2 10
10.5 20.9 29.1 10.8
9.9 19.6 28.8 10.3
9.7 20.7 31 9.6
9.3 19.7 30.3 9.9
11 24 35 -0.2
12 23 37 -0.4
12 26 34 0.7
11 34 34 0.1
3.4 2.9 2.1 -0.4
3.1 2.2 0.3 0.6
0 1.6 0.2 -0.2
2.3 1.6 2 0
0.8 2.9 1.6 0.1
3.1 3.4 2.2 0.4
2.6 2.2 1.9 0.9
0.4 3.2 1.9 0.3
2 2.3 0.8 -0.8
1.3 2.3 0.5 0.7
1 0 0.4 -0.3
0.9 3.3 2.5 -0.8
3.3 2.5 2.9 -0.7
1.8 0.8 2 0.3
1.2 0.9 0.8 0.3
1.2 0.7 3.4 -0.3
3.1 1.4 1 0
0.5 2.4 0.3 -0.4
1.5 3.1 1.5 -0.6
0.4 0 0.7 -0.7
3.1 2.4 3 0.3
1.1 2.2 2.7 -1
0.1 3 2.6 -0.6
1.5 1.2 0.2 0.9
2.1 0 1.2 -0.7
0.5 2 1.2 -0.5
3.4 1.6 2.9 -0.1
0.3 1 2.7 -0.7
0.1 3.3 0.9 0.6
1.8 0.5 3.2 -0.7
1.9 0.1 0.6 -0.5
1.8 0.5 3 -0.4
3 0.1 0.8 -0.9
3.1 1.6 3 0.1
3.1 2.5 1.9 0.9
2.1 2.8 2.9 -0.4
2.3 1.5 0.4 0.7
3.3 0.6 1.2 -0.5
0.3 0.4 3.3 0.7
1.1 3 0.3 0.7
0.5 2.4 0.9 0
1.8 3.2 0.9 0.1
1.8 0.7 0.7 0.7
2.4 3.4 1.5 -0.1
1.6 2.1 3 -0.3
0.3 1.5 3.3 -0.9
0.4 3.4 3 -0.3
0.9 0.1 0.3 0.6
1.1 2.7 0.2 -0.3
2.8 3 2.9 -0.5
2 0.7 2.7 0.6
0.2 1.8 0.8 -0.9
1.6 2 1.2 -0.7
0.1 0 1.1 0.6
2 0.6 0.3 0.2
1 2.2 2.9 0.7
2.2 2.5 2.3 0.2
0.6 2 1.5 -0.2
0.3 1.7 2.2 0.4
0 2.2 1.6 -0.9
0.3 0.4 2.6 0.2
"""

# Rousseeuw and Leroy (1987), calls from Belgium: year less 1900; tens of millions of calls.
_TELEF = """
50 0.44
51 0.47
52 0.47
53 0.59
54 0.66
55 0.73
56 0.81
57 0.88
58 1.06
59 1.2
60 1.35
61 1.49
62 1.61
63 2.12
64 11.9
65 12.4
66 14.2
67 15.9
68 18.2
69 21.2
70 4.3
71 2.4
72 2.7
73 2.9
"""

# Ruppert and Carroll (1980), Pamlico Sound: lagged salinity, trend, river discharge; salinity.
_SALINITY = """
8.2 4 23.005 7.6
7.6 5 23.873 7.7
4.6 0 26.417 4.3
4.3 1 24.868 5.9
5.9 2 29.895 5
5 3 24.2 6.5
6.5 4 23.215 8.3
8.3 5 21.862 8.2
10.1 0 22.274 13.2
13.2 1 23.83 12.6
12.6 2 25.144 10.4
10.4 3 22.43 10.8
10.8 4 21.785 13.1
13.1 5 22.38 12.3
13.3 0 23.927 10.4
10.4 1 33.443 10.5
10.5 2 24.859 7.7
7.7 3 22.686 9.5
10 0 21.789 12
12 1 22.041 12.6
12.1 4 21.033 13.6
13.6 5 21.005 14.1
15 0 25.865 13.5
13.5 1 26.29 11.5
11.5 2 22.932 12
12 3 21.313 13
13 4 20.769 14.1
14.1 5 21.393 15.1
"""

# Coleman et al. (1966), 20 schools: five properties of staff and pupils; mean verbal score.
_COLEMAN = """
3.83 28.87 7.2 26.6 6.19 37.01
2.89 20.1 -11.71 24.4 5.17 26.51
2.86 69.05 12.32 25.7 7.04 36.51
2.92 65.4 14.28 25.7 7.1 40.7
3.06 29.59 6.31 25.4 6.15 37.1
2.07 44.82 6.16 21.6 6.41 33.9
2.52 77.37 12.7 24.9 6.86 41.8
2.45 24.67 -0.17 25.01 5.78 33.4
3.13 65.01 9.85 26.6 6.51 41.01
2.44 9.99 -0.05 28.01 5.57 37.2
2.09 12.2 -12.86 23.51 5.62 23.3
2.52 22.55 0.92 23.6 5.34 35.2
2.22 14.3 4.77 24.51 5.8 34.9
2.67 31.79 -0.96 25.8 6.19 33.1
2.71 11.6 -16.04 25.2 5.62 22.7
3.14 68.47 10.62 25.01 6.94 39.7
3.54 42.64 2.66 25.01 6.33 31.8
2.52 16.7 -10.99 24.8 6.01 31.7
2.68 86.27 15.03 25.51 7.51 43.1
2.37 76.73 12.77 24.51 6.96 41.01
"""


def _read(table: str) -> tuple[Tensor, Tensor]:
    lines = table.strip().splitlines()
    values = torch.tensor([[float(cell) for cell in line.split()] for line in lines], dtype=torch.float64)
    return torch.cat([torch.ones_like(values[:, :1]), values[:, :-1]], dim=1), values[:, -1]


def stackloss() -> tuple[Tensor, Tensor]:
    """X (21, 4) with an intercept column first, and y."""
    return _read(_STACKLOSS)


def stars_cyg() -> tuple[Tensor, Tensor]:
    """X (47, 2) with an intercept column first, and y."""
    return _read(_STARS_CYG)


def hbk() -> tuple[Tensor, Tensor]:
    """X (75, 4) with an intercept column first, and y."""
    return _read(_HBK)


def telef() -> tuple[Tensor, Tensor]:
    """X (24, 2) with an intercept column first, and y."""
    return _read(_TELEF)


def salinity() -> tuple[Tensor, Tensor]:
    """X (28, 4) with an intercept column first, and y."""
    return _read(_SALINITY)


def coleman() -> tuple[Tensor, Tensor]:
    """X (20, 6) with an intercept column first, and y."""
    return _read(_COLEMAN)


class Reference(NamedTuple):
    """Reference fits of one data set; ``None`` where none is known."""

    least_squares: tuple[float, ...]
    lad: tuple[float, ...]
    lad_objective: float  # sum of absolute residuals
    huber: tuple[float, ...]  # c = 1.345, scale MAD, from least squares
    tukey: tuple[float, ...]  # c = 4.685, scale MAD, from least squares
    lts: TrimmedReference | None = None
    mm: MMReference | None = None
    lms: MedianReference | None = None
    mkc: tuple[MKCReference, ...] = ()


class TrimmedReference(NamedTuple):
    """Least trimmed squares at the highest breakdown point, h = (n + p + 1) // 2, exact."""

    h: int
    objective: float  # sum of the h smallest squared residuals
    coef: tuple[float, ...]  # raw, before reweighting
    rejected: tuple[int, ...]  # rows, counted from 1, that R rejects after reweighting


class MedianReference(NamedTuple):
    """Least median of squares, exact."""

    h: int
    objective: float  # h-th smallest absolute residual
    coef: tuple[float, ...] | None = None


class MMReference(NamedTuple):
    """Bisquare MM, breakdown point 0.5, c = 1.547645 and 4.685061."""

    scale: float  # of the S estimate
    coef: tuple[float, ...]
    rejected: tuple[int, ...] = ()  # rows, counted from 1, of weight below 0.01


class MKCReference(NamedTuple):
    """Fixed point of the kernel fit, which depends on h = sigma d alone."""

    h: float
    starts: tuple[str, ...]  # of "least_squares" and "s", those known to lead there
    coef: tuple[float, ...]


REFERENCE = {
    "stackloss": Reference(
        least_squares=(-39.91967442, 0.7156402, 1.29528612, -0.15212252),
        lad=(-39.68985507, 0.83188406, 0.57391304, -0.06086957),
        lad_objective=42.081159420,
        huber=(-41.02649835, 0.82938433, 0.92606597, -0.12784672),
        tukey=(-42.28535078, 0.92755732, 0.65071769, -0.11233315),
        lts=TrimmedReference(13, 2.932391246, (-37.32332647, 0.7409210642, 0.3915267228, 0.01113453977), (1, 3, 4, 21)),
        mm=MMReference(1.912346, (-41.524595, 0.938846, 0.579551, -0.112922)),
        lms=MedianReference(11, 0.37941176),
        mkc=(MKCReference(4.0, ("least_squares", "s"), (-41.3096061294, 0.9173119484, 0.6371809613, -0.1145319558)),),
    ),
    "stars_cyg": Reference(
        least_squares=(6.7934673, -0.41330386),
        lad=(8.14920455, -0.69318182),
        lad_objective=21.945227273,
        huber=(6.86588698, -0.42852318),
        tukey=(6.82350699, -0.41798001),
        lts=TrimmedReference(25, 0.83689285, (-13.6239903, 4.2191821), (7, 9, 11, 20, 30, 34)),
        mm=MMReference(0.471456, (-4.969397, 2.253163), (11, 20, 30, 34)),
        lms=MedianReference(24, 0.26),
    ),
    "hbk": Reference(
        least_squares=(-0.38754955, 0.23918479, -0.33454848, 0.38334082),
        lad=(-0.88147448, 0.09131168, 0.15476022, 0.21464706),
        lad_objective=86.742869525,
        huber=(-0.7799114, 0.16635669, 0.01192691, 0.27214254),
        tukey=(-0.94588008, 0.1448563, 0.19735731, 0.18025086),
        lts=TrimmedReference(40, 2.9473024, (-0.6115165, 0.2548662, 0.0478557, -0.1057698), tuple(range(1, 11))),
        mm=MMReference(0.789171, (-0.189616, 0.085274, 0.041013, -0.053713)),
        mkc=(
            MKCReference(1.5, ("s",), (-0.1942171915, 0.0872402593, 0.0415116852, -0.0546971154)),
            MKCReference(1.5, ("least_squares",), (-0.9549132735, 0.1455853046, 0.201282181, 0.1778313786)),
        ),
    ),
    "telef": Reference(
        least_squares=(-26.00592464, 0.50414783),
        lad=(-7.519, 0.153),  # one of several optima: (-8.1, 0.16222222) is another
        lad_objective=84.4,
        huber=(-10.25301516, 0.20396107),
        tukey=(-5.2302519, 0.10980467),
        lms=MedianReference(13, 0.086, (-5.6175, 0.1155)),
        mkc=(MKCReference(1.0, (), (-5.5362691447, 0.1155512898)),),
    ),
}

COLEMAN_LTS = TrimmedReference(
    13,
    0.6662200314017414,  # of all 77520 choices; the second best has 0.9721, where a search may end
    (
        21.796835213754076,
        -0.01129068858889826,
        0.05351927524799519,
        0.6268099459328487,
        0.8681703501029238,
        -2.011137505,
    ),
    (),
)

DATA_SETS = {
    "stackloss": stackloss,
    "stars_cyg": stars_cyg,
    "hbk": hbk,
    "telef": telef,
    "salinity": salinity,
    "coleman": coleman,
}
