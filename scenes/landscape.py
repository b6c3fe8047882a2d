"""The landscapes of the shipped scenes, made of noise: ``python -m atmo_jit.scenes.landscape FOLDER`` writes them anew.

Heights are ridged multifractal noise (Musgrave, Kolb and Mace 1989) on a grid that lies on the planet's sphere:
a plain of 100 km drops by 800 m at its end. Vertices are in metres, z up, the origin on the sphere.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

RADIUS_M = 6360e3
TALLEST_M = 2400.0


def noise(x: np.ndarray, y: np.ndarray, seed: int) -> np.ndarray:
    """Gradient noise (Perlin 2002) in about [-1, 1] at points of the plane; one cell is 1 x 1."""
    corner = np.floor(np.stack([x, y])).astype(np.int64)
    fx, fy = x - corner[0], y - corner[1]
    angle = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi, (256, 256))

    def slope(i: int, j: int) -> np.ndarray:
        a = angle[(corner[0] + i) % 256, (corner[1] + j) % 256]
        return np.cos(a) * (fx - i) + np.sin(a) * (fy - j)

    sx, sy = (f * f * f * (f * (6.0 * f - 15.0) + 10.0) for f in (fx, fy))
    low = slope(0, 0) + sx * (slope(1, 0) - slope(0, 0))
    high = slope(0, 1) + sx * (slope(1, 1) - slope(0, 1))
    return 1.6 * (low + sy * (high - low))


def ridges(x: np.ndarray, y: np.ndarray, seed: int, octaves: int) -> np.ndarray:
    """Ridged multifractal noise in [0, 1]: sharp where the noise changes sign, rougher where it is high."""
    total, weight, scale, sum_ = 0.0, np.ones_like(x), 1.0, 0.0
    for i in range(octaves):
        signal = (1.0 - np.abs(noise(x * scale, y * scale, seed + i))) ** 2 * weight
        weight = np.clip(1.4 * signal, 0.0, 1.0)
        total, sum_, scale = total + signal * scale**-0.95, sum_ + scale**-0.95, scale * 2.03
    return np.clip(total / sum_, 0.0, 1.0)


def smooth_step(x: np.ndarray) -> np.ndarray:
    x = np.clip(x, 0.0, 1.0)
    return x * x * (3.0 - 2.0 * x)


def grid(x: np.ndarray, y: np.ndarray, height: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [N, 3] and triangles [M, 3] of heights (m) over distances x and y along the ground, arrays [n, m]."""
    distance = np.hypot(x, y)
    angle = distance / RADIUS_M
    across = (RADIUS_M + height) * np.sin(angle) / np.maximum(distance, 1e-9)
    drop = -2.0 * RADIUS_M * np.sin(0.5 * angle) ** 2  # R (cos - 1)
    z = drop + height * np.cos(angle)
    rows, columns = x.shape
    i = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = i[:-1, :-1], i[:-1, 1:], i[1:, 1:], i[1:, :-1]
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    return np.stack([x * across, y * across, z], -1).reshape(-1, 3), faces


def mountains() -> tuple[np.ndarray, np.ndarray]:
    """24 x 24 km of mountains about a valley that runs along y through the origin."""
    x, y = np.meshgrid(np.linspace(-12e3, 12e3, 161), np.linspace(-4e3, 20e3, 161), indexing="xy")
    bend = 700.0 * np.sin(y / 5200.0) * smooth_step(y / 6000.0)
    beside = smooth_step((np.abs(x - bend) - 500.0) / 3500.0)
    end = smooth_step((y - 13e3) / 6e3)
    rough = ridges(x / 7200.0 + 3.3, y / 7200.0 + 1.7, 11, 6)
    height = TALLEST_M * rough * (0.04 + 0.96 * np.maximum(beside, 0.75 * end))
    edge = np.minimum.reduce([x + 12e3, 12e3 - x, y + 4e3, 20e3 - y])
    return grid(x, y, height * smooth_step(edge / 1500.0))


def ranges() -> tuple[np.ndarray, np.ndarray]:
    """Range behind range, from 4 to 105 km."""
    y = np.geomspace(3e3, 110e3, 320)
    s = np.linspace(-1.0, 1.0, 128)
    y, s = np.meshgrid(y, s, indexing="ij")
    x = s * (2500.0 + 0.5 * y)
    # One crest for each factor of 1.7 in distance, higher the farther it is.
    u = np.log(y / 4e3) / np.log(1.7)
    crest = np.exp(-(((u - np.round(u)) / 0.16) ** 2)) * (np.round(u) >= 0)
    rough = 0.35 + 0.65 * ridges(x / (0.35 * y) + 9.1 * np.round(u), u * 2.1 + 0.7, 23, 6)
    return grid(x, y, crest * rough * (90.0 + 0.022 * y))


def city() -> tuple[np.ndarray, np.ndarray]:
    """Blocks of 60 m with streets of 20 m between them: four houses to a block, a few towers."""
    rng = np.random.default_rng(4)
    box = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (0, 1)], dtype=np.float64)
    sides = np.array([[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [1, 3, 7, 5]])  # no floor
    vertices, faces = [], []
    for i in range(-8, 9):
        for j in range(0, 22):
            if i == 0:
                continue  # the street that the camera looks along
            for dx, dy in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
                tall = 14.0 + 30.0 * rng.random() ** 2 + (90.0 + 70.0 * rng.random()) * (rng.random() < 0.06)
                size = np.array([*(rng.uniform(10.5, 14.5, 2)), tall])
                place = np.array([80.0 * i + 15.0 * dx, 80.0 * j + 15.0 * dy + 60.0, 0.0])
                first = 8 * len(vertices)
                vertices.append(box * size + place)
                faces.append(np.concatenate([sides[:, [0, 1, 2]], sides[:, [0, 2, 3]]]) + first)
    return np.concatenate(vertices), np.concatenate(faces)


LANDSCAPES = {"mountains": mountains, "ranges": ranges, "city": city}


def write(path: Path, vertices: np.ndarray, faces: np.ndarray) -> None:
    """A binary PLY file; normals are left to the reader."""
    head = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(vertices)}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    rows = np.empty(len(faces), dtype=[("count", "u1"), ("index", "<i4", 3)])
    rows["count"], rows["index"] = 3, faces
    path.write_bytes(head.encode() + vertices.astype("<f4").tobytes() + rows.tobytes())


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    given = parser.parse_args(arguments)
    given.folder.mkdir(parents=True, exist_ok=True)
    for name, make in LANDSCAPES.items():
        write(given.folder / f"{name}.ply", *make())
    return 0


if __name__ == "__main__":
    sys.exit(main())
