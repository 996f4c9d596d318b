"""A wall found in a range image, after Figure 10 of Indiveri (2009).

    python examples/paper/lel_range_image.py --output lel_range_image.png

G. Indiveri, "An Entropy-Like Estimator for Robust Parameter Identification", Entropy 11 (2009) 560-585, shows a wall
that the estimator found in the image of a 3D range camera in an office; the recording is not given. This one is
synthetic: a pinhole camera of 176 x 144 pixels sees a wall behind a floor, a desk, a cabinet and a person, with noise,
and with pixels that mix the foreground and the background.
"""

from __future__ import annotations

import argparse
import math
import time
from dataclasses import dataclass

import torch
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table
from torch import Tensor

from mkc_torch.linear import LeastEntropyLike, LeastSquares

WIDTH, HEIGHT = 176, 144
FOCAL = 150.0  # pixels
NOISE = 0.01  # m
MIXED = 0.03  # share of pixels
FLOOR = 1.7  # m below the camera
WALL = (-0.25, 0.03, 4.2)  # z = a x + b y + c, camera frame: x right, y down, z forward, m


@dataclass(frozen=True)
class Box:
    """A fronto-parallel rectangle at a depth, m."""

    left: float
    right: float
    top: float
    bottom: float
    depth: float


FURNITURE = (
    Box(1.15, 1.6, -0.2, 1.7, 2.9),  # cabinet
    Box(-1.55, -0.35, 0.55, 0.62, 2.6),  # desk top
    Box(-1.45, -1.38, 0.62, 1.7, 2.6),  # its legs
    Box(-0.55, -0.48, 0.62, 1.7, 2.6),
    Box(-1.2, -0.8, 0.25, 0.55, 2.6),  # screen
    Box(0.05, 0.36, -0.1, 1.7, 2.4),  # person
    Box(0.12, 0.29, -0.36, -0.1, 2.4),
)


@dataclass(frozen=True)
class Scene:
    """Points (H, W, 3) in m, and which pixels are the wall's."""

    points: Tensor
    wall: Tensor


def scene(generator: torch.Generator) -> Scene:
    v, u = torch.meshgrid(
        torch.arange(HEIGHT, dtype=torch.float64), torch.arange(WIDTH, dtype=torch.float64), indexing="ij"
    )
    rays = torch.stack([(u - (WIDTH - 1) / 2) / FOCAL, (v - (HEIGHT - 1) / 2) / FOCAL, torch.ones_like(u)], -1)
    a, b, c = WALL
    depth = c / (1.0 - a * rays[..., 0] - b * rays[..., 1])
    wall = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    floor = FLOOR / rays[..., 1].clamp(min=1e-6)
    surfaces = [floor]
    for box in FURNITURE:
        x, y = rays[..., 0] * box.depth, rays[..., 1] * box.depth
        inside = (x >= box.left) & (x <= box.right) & (y >= box.top) & (y <= box.bottom)
        surfaces.append(torch.where(inside, box.depth, math.inf))
    for surface in surfaces:
        wall &= surface >= depth
        depth = torch.minimum(depth, surface)
    mixed = torch.rand(HEIGHT, WIDTH, generator=generator) < MIXED
    share = torch.rand(HEIGHT, WIDTH, generator=generator, dtype=torch.float64)
    depth = torch.where(mixed, 1.0 + share * (depth - 1.0), depth)
    depth = depth + NOISE * torch.randn(HEIGHT, WIDTH, generator=generator, dtype=torch.float64)
    return Scene(rays * depth.unsqueeze(-1), wall & ~mixed)


def regression(points: Tensor) -> tuple[Tensor, Tensor]:
    """X (N, 3) and z (N,) of ``z = a x + b y + c``."""
    flat = points.reshape(-1, 3)
    return torch.stack([flat[:, 0], flat[:, 1], torch.ones_like(flat[:, 0])], -1), flat[:, 2]


def angle(plane: Tensor) -> float:
    """Degrees between the normals of a plane and of the wall."""
    normals = torch.tensor([[*plane[:2].tolist(), -1.0], [*WALL[:2], -1.0]], dtype=torch.float64)
    normals = normals / normals.norm(dim=-1, keepdim=True)
    return math.degrees(math.asin(float(torch.linalg.cross(normals[0], normals[1]).norm())))


def found(residual: Tensor) -> Tensor:
    """Pixels within 2.5 robust scales of the plane, the scale being 1.4826 MAD, (19)-(21)."""
    middle = residual.median()
    return residual.abs() <= 2.5 * 1.4826 * (residual - middle).abs().median()


def planes_of(X: Tensor, z: Tensor) -> dict[str, Tensor]:
    """Least squares, least H, and least squares on what least H found, (26) and (29)."""
    lel = LeastEntropyLike().fit(X, z).coef_
    kept = found(z - X @ lel)
    return {
        "LS": LeastSquares().fit(X, z).coef_,
        "LEL": lel,
        "LEL, then LS": LeastSquares().fit(X[kept], z[kept]).coef_,
    }


def show_shares(console: Console, X: Tensor, z: Tensor, wall: Tensor, generator: torch.Generator) -> None:
    """The same image with more or fewer of the pixels that are not the wall's."""
    table = Table(title="angle off, °, over the share of pixels that the wall has")
    others = (~wall).nonzero().squeeze(-1)
    others = others[torch.randperm(len(others), generator=generator)]
    pixels = wall.nonzero().squeeze(-1)
    shares = (0.95, 0.9, 0.8, 0.7, 0.6, 0.5)
    rows = []
    for share in shares:
        few = min(len(others), round(len(pixels) * (1 - share) / share))
        kept = round(few * share / (1 - share))
        some = pixels[torch.randperm(len(pixels), generator=generator)[:kept]]
        index = torch.cat([some, others[:few]])
        rows.append([angle(p) for p in planes_of(X[index], z[index]).values()])
    for heading in ("", *(f"{s:.0%}" for s in shares)):
        table.add_column(heading, justify="right" if heading else "left")
    for name, *values in zip(("LS", "LEL", "LEL, then LS"), *rows, strict=True):
        table.add_row(name, *(f"{v:.2f}" for v in values))
    console.print(table)


def picture(path: str, image: Scene, planes: dict[str, Tensor]) -> None:
    depth = image.points[..., 2]
    figure = Figure(figsize=(12.0, 3.5), layout="constrained")
    panels = figure.subplots(1, 1 + len(planes))
    shown = panels[0].imshow(depth.numpy(), cmap="viridis_r", vmin=1.0, vmax=5.0)
    panels[0].set_title("depth, m")
    figure.colorbar(shown, ax=panels[0], shrink=0.8)
    X, z = regression(image.points)
    for panel, (name, plane) in zip(panels[1:], planes.items(), strict=True):
        mask = found(z - X @ plane).reshape(HEIGHT, WIDTH)
        panel.imshow(depth.numpy(), cmap="gray_r", vmin=0.5, vmax=6.0)
        overlay = torch.where(mask, 1.0, math.nan)
        panel.imshow(overlay.numpy(), cmap=ListedColormap(["red"]), alpha=0.55)
        panel.set_title(f"{name}: pixels on its plane, in red")
    for panel in panels:
        panel.set_axis_off()
    figure.savefig(path, dpi=150)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", metavar="PICTURE.png")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    console = Console(width=120)
    image = scene(torch.Generator().manual_seed(options.seed))
    X, z = regression(image.points)
    LeastEntropyLike().fit(X[:100], z[:100])  # the first call pays for loading
    start = time.perf_counter()
    lel = LeastEntropyLike().fit(X, z)
    elapsed = time.perf_counter() - start
    planes = planes_of(X, z)
    wall = image.wall.reshape(-1)
    table = Table(title=f"The wall, {float(wall.double().mean()):.0%} of {len(z)} pixels: z = a x + b y + c")
    for heading in ("", "a, b, c", "angle off, °", "offset off, mm", "wall pixels found", "others found"):
        table.add_column(heading, justify="right" if heading else "left")
    for name, plane in planes.items():
        mask = found(z - X @ plane)
        table.add_row(
            name,
            ", ".join(f"{v:.3f}" for v in plane.tolist()),
            f"{angle(plane):.2f}",
            f"{1e3 * (float(plane[2]) - WALL[2]):.0f}",
            f"{float(mask[wall].double().mean()):.1%}",
            f"{float(mask[~wall].double().mean()):.1%}",
        )
    table.add_row("truth", ", ".join(f"{v:.3f}" for v in WALL))
    console.print(table)
    minima = ", ".join(f"{h:.4f}" for h in lel.minima_entropy_.tolist())
    console.print(f"H of the minima from the three starts: {minima}; {1e3 * elapsed:.0f} ms for all of them.")
    show_shares(console, X, z, wall, torch.Generator().manual_seed(options.seed))
    if options.output:
        picture(options.output, image, {name: planes[name] for name in ("LS", "LEL")})
        console.print(f"The picture is in {options.output}.")


if __name__ == "__main__":
    main()
