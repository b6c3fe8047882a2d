"""Unbiased truth for any atmosphere: spherical backward Monte Carlo in double precision.

It shares no code with the package. Order 1 and directly lit ground come from the tests' quadrature twin, exactly; this
adds orders >= 2 and their noise. One process per question::

    python -m bench.monte_carlo --atmosphere FILE.json --views VIEWS.npz --out TRUTH.npz --paths 400000

VIEWS.npz as for ``atmo-jit sky``; TRUTH.npz holds ``radiance`` and ``sigma`` (one standard error) [N, W].

Method. Everything that depends on the atmosphere is tabulated finely from the twin: densities over altitude (linear),
columns to the sun over altitude and cosine for rising rays (a sinking ray is twice its perigee's less its own),
quantiles of the distance to the first event along every view ray, quantiles of every phase function. The first event of
a path is forced; from there on free paths are sampled by delta tracking with a majorant per shell, directions from the
phase function, and at every event but the first the sun is asked for. Russian roulette ends paths after eight events.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import sys
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType

import drjit as dr
import numpy as np
from drjit.llvm.ad import PCG32, Bool, Float64, UInt32

from .walk_tables import QUANTILES, SHELLS, Tables, buffer, lookup

ROULETTE_FROM, MOST_EVENTS = 8, 400


def load_twins() -> ModuleType:
    """The tests' module of twins, wherever this is run from."""
    path = Path(__file__).resolve().parents[1] / "tests" / "twins.py"
    spec = importlib.util.spec_from_file_location("twins", path)
    module = importlib.util.module_from_spec(spec)
    sys.modules.setdefault("twins", module)
    spec.loader.exec_module(module)
    return module


class MonteCarlo(Tables):
    """The random walk through an atmosphere (a ``twins.Twin``)."""

    def orders_from_two(self, views: Mapping[str, np.ndarray], paths: int, seed: int = 0, batch: int = 1 << 20):
        """(mean, standard error) [N, W] of the radiance of all orders >= 2 for sunlight of irradiance 1."""
        count = views["mu"].size * self.width
        self.first_events(views)
        per_batch = max(1, min(paths, batch // count))
        batches = -(-paths // per_batch)
        total = square = 0.0
        for index in range(batches):
            value = self._walk(views, per_batch, seed * 100_003 + index)
            total = total + np.array(dr.block_sum(value, per_batch))
            square = square + np.array(dr.block_sum(value * value, per_batch))
        size = batches * per_batch
        mean = total / size
        error = np.sqrt(np.maximum(square / size - mean**2, 0.0) / size)
        return mean.reshape(-1, self.width), error.reshape(-1, self.width)

    def _walk(self, views: Mapping[str, np.ndarray], paths: int, seed: int) -> Float64:
        n = views["mu"].size * self.width * paths
        lane = dr.arange(UInt32, n)
        task = lane // paths
        view, w = task // self.width, task % self.width
        rng = PCG32(size=n, initstate=seed + 1, initseq=dr.arange(dr.uint64_array_t(Float64), n))
        h, mu, mu_s, nu = (dr.gather(Float64, buffer(views[k]), view) for k in ("h", "mu", "mu_s", "nu"))
        hits = dr.gather(Float64, buffer(self.hits.astype(float)), view) > 0
        # Cartesian, the observer on the z axis and the sun in the x-z plane, y >= 0 for the view: mirror symmetry.
        sin_s = dr.safe_sqrt(1 - mu_s * mu_s)
        vx = dr.select(sin_s > 1e-12, (nu - mu * mu_s) / dr.maximum(sin_s, 1e-12), dr.safe_sqrt(1 - mu * mu))
        vy = dr.safe_sqrt(1 - mu * mu - vx * vx)
        sun = (sin_s, Float64(0.0) * sin_s, mu_s)
        direction = [vx, vy, mu]
        probability = dr.gather(Float64, self.first_probability, task)
        u = rng.next_float64()
        ground = hits & (u >= probability)
        weight = dr.select(hits, 1.0, probability)
        rank = dr.select(hits, u, u * probability) / dr.maximum(probability, 1e-300) * (QUANTILES - 1)
        distance = lookup(self.first_distance, rank, QUANTILES, task * QUANTILES)
        r0 = self.radius + h
        to_ground = -r0 * mu - dr.safe_sqrt(r0 * r0 * mu * mu - h * (2 * self.radius + h))
        distance = dr.select(ground, to_ground, distance)
        position = [distance * vx, distance * vy, dr.fma(distance, mu, r0)]
        alive = weight > 0
        total = Float64(0.0) * weight
        event = UInt32(0) * lane

        def step(alive, position, direction, weight, ground, event, total, rng):
            r = dr.sqrt(sum(c * c for c in position))
            h = dr.clip(r - self.radius, 0.0, self.top)
            up = [c / r for c in position]
            cos_sun = sum(a * b for a, b in zip(up, sun, strict=True))
            nu = sum(a * b for a, b in zip(direction, sun, strict=True))
            density = self.densities(h)
            scattering = self.coefficient(self.scattering, density, w)
            extinction = sum(self.coefficient(self.extinction, density, w))
            scattered = sum(scattering)
            albedo = dr.gather(Float64, self.albedo, w)
            # The sun's light at this event, seen along the way that led here.
            angle = dr.acos(dr.clip(nu, -1.0, 1.0)) / np.pi * 20_000
            toward = Float64(0.0)
            for k in range(self.count):
                if self.phase_value[k] is not None:
                    toward += scattering[k] * lookup(self.phase_value[k], angle, 20_001, w * 20_001)
            toward = dr.select(
                ground, albedo / np.pi * dr.maximum(cos_sun, 0.0), toward / dr.maximum(extinction, 1e-300)
            )
            lit = self.sunlight(h, cos_sun, w)
            total = total + dr.select(alive & (event > 0), weight * toward * lit, 0.0)
            # A new direction: Lambertian from the ground, by the phase function of one species in the air.
            weight = weight * dr.select(ground, albedo, scattered / dr.maximum(extinction, 1e-300))
            pick, theta = rng.next_float64() * scattered, rng.next_float64()
            turn = 2 * np.pi * rng.next_float64()
            cosine, chosen = Float64(0.0), Bool(False)
            for k in range(self.count):
                if self.phase_value[k] is not None:
                    mine = ~chosen & (pick <= scattering[k])
                    bent = lookup(self.phase_quantile[k], theta * (QUANTILES - 1), QUANTILES, w * QUANTILES)
                    cosine = dr.select(mine, dr.cos(bent), cosine)
                    chosen = chosen | mine
                    pick = pick - scattering[k]
            axis = [dr.select(ground, a, b) for a, b in zip(up, direction, strict=True)]
            cosine = dr.select(ground, dr.sqrt(theta), cosine)
            direction = _turned(axis, cosine, turn)
            event = event + 1
            survive = dr.select(event > ROULETTE_FROM, dr.clip(weight, 0.05, 1.0), 1.0)
            alive = alive & (weight > 0) & (rng.next_float64() < survive) & (event < MOST_EVENTS)
            weight = weight / survive
            position = [dr.select(ground, c * (self.radius / r), c) for c in position]
            position, ground, alive = self._fly(position, direction, alive, ground, w, rng)
            return alive, position, direction, weight, ground, event, total, rng

        state = (alive, position, direction, weight, ground, event, total, rng)
        result = dr.while_loop(state, lambda alive, *_: alive, step, label="walk")
        dr.eval(result[6])
        return result[6]

    def _fly(self, position, direction, alive, from_ground, w, rng):
        """Delta tracking to the next event: (position, on the ground, still inside)."""
        r0 = dr.sqrt(sum(c * c for c in position))
        h0 = dr.select(from_ground, 0.0, dr.clip(r0 - self.radius, 0.0, self.top))
        mu0 = sum(a * b for a, b in zip(position, direction, strict=True)) / r0
        r0 = self.radius + h0

        def altitude(d):
            change = d * dr.fma(2 * r0, mu0, d)
            return h0 + change / (r0 + dr.safe_sqrt(dr.fma(r0, r0, change)))

        def crossing(level, sign):
            q = (level - h0) * (2 * self.radius + h0 + level)
            return -r0 * mu0 + sign * dr.safe_sqrt(r0 * r0 * mu0 * mu0 + q)

        perigee = -r0 * mu0
        lowest = r0 * dr.safe_sqrt(1 - mu0 * mu0) - self.radius
        meets = (mu0 < 0) & (lowest <= 0)
        end = dr.select(meets, crossing(Float64(0.0), -1), crossing(Float64(self.top), 1))
        d = Float64(0.0) * r0
        collided = Bool(False) & alive
        busy = alive & True

        def step(busy, d, collided, rng):
            h = dr.clip(altitude(d), 0.0, self.top)
            falling = d < perigee
            shell = dr.minimum(UInt32((h / self.top) ** (2 / 3) * SHELLS), SHELLS - 1)
            shell = shell - dr.select((dr.gather(Float64, self.levels, shell) > h) & (shell > 0), UInt32(1), UInt32(0))
            low, high = dr.gather(Float64, self.levels, shell), dr.gather(Float64, self.levels, shell + 1)
            into = dr.select(lowest < low, crossing(low, -1), perigee)
            edge = dr.maximum(dr.select(falling, into, crossing(high, 1)), d) + 1e-3
            majorant = dr.gather(Float64, self.majorant, w * SHELLS + shell)
            # The millimetre past the edge may touch the neighbour: its majorant differs by less than the margin below.
            free = d - dr.log(1 - rng.next_float64()) / majorant
            reached = free < edge
            there = dr.clip(altitude(free), 0.0, self.top)
            extinction = sum(self.coefficient(self.extinction, self.densities(there), w))
            hit = reached & (free < end) & (rng.next_float64() * majorant < extinction)
            d = dr.minimum(dr.select(reached, free, edge), end)
            return busy & ~hit & (d < end), d, collided | (busy & hit), rng

        _, d, collided, _ = dr.while_loop((busy, d, collided, rng), lambda busy, *_: busy, step, label="fly")
        on_ground = alive & ~collided & meets
        position = [dr.fma(d, b, a) for a, b in zip(position, direction, strict=True)]
        return position, on_ground, alive & (collided | on_ground)


def _turned(axis: list[Float64], cosine: Float64, turn: Float64) -> list[Float64]:
    """Unit vectors at the angle with ``cosine`` from ``axis``, turned about it by ``turn``."""
    x, y, z = axis
    sign = dr.copysign(Float64(1.0), z)
    a = -1 / (sign + z)
    b = x * y * a
    sine = dr.safe_sqrt(1 - cosine * cosine)
    u, v = sine * dr.cos(turn), sine * dr.sin(turn)
    return [
        u * (1 + sign * x * x * a) + v * b + cosine * x,
        u * sign * b + v * (sign + y * y * a) + cosine * y,
        -u * sign * x - v * y + cosine * z,
    ]


def truth(spec: Mapping, views: Mapping[str, np.ndarray], paths: int = 100_000, seed: int = 0):
    """(radiance, standard error) [N, W] for contract JSON, all orders and the ground's own light."""
    twins = load_twins()
    twin = twins.Twin(spec)
    columns = {k: np.atleast_1d(np.asarray(v, float)) for k, v in views.items()}
    mu, mu_s, nu = twins.cosines(*(columns[f"{k}_deg"] for k in ("sun_zenith", "view_zenith", "azimuth")))
    h = columns["altitude_m"] + 0 * mu
    exact = twin.single_scattering(h, mu, mu_s, nu) + twin.ground_direct(h, mu, mu_s, nu)
    mean, sigma = MonteCarlo(twin).orders_from_two({"h": h, "mu": mu, "mu_s": mu_s, "nu": nu}, paths, seed)
    return exact + twin.solar * mean, twin.solar * sigma


def main(arguments: list[str] | None = None) -> int:
    """Command line."""
    parser = argparse.ArgumentParser(prog="python -m bench.monte_carlo", description=__doc__.splitlines()[0])
    parser.add_argument("--atmosphere", type=Path, required=True, help="contract JSON")
    parser.add_argument("--views", type=Path, required=True, help="views as for atmo-jit sky (no distance_m)")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--paths", type=int, default=100_000, help="paths per view and wavelength")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    with np.load(options.views) as file:
        views = dict(file)
    radiance, sigma = truth(
        json.loads(options.atmosphere.read_text(encoding="utf-8")), views, options.paths, options.seed
    )
    np.savez(options.out, radiance=radiance, sigma=sigma)
    return 0


if __name__ == "__main__":
    sys.exit(main())
