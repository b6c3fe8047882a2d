"""The path-traced medium against the reference data that no code of this project made.

    python -m bench.reference_medium sky --samples 100000            # all orders of scattering, 17 atmospheres
    python -m bench.reference_medium single --samples 100000         # single scattering and directly lit ground
    python -m bench.reference_medium efficiency                      # 1 / (variance x CPU time) against `heterogeneous`

Each line is one atmosphere: number of rays, rms of z = (difference) / (both standard errors), largest abs(z), and the
bias: the mean relative difference, weighted by 1 / variance, with its standard error. Rays of which too few paths
bring any light for their own standard error to be known are left out and counted (a view of black ground from 1 m
needs 10^6 paths for one, and with few their scatter says nothing of the error).
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass

import numpy as np

from . import reference

LEAST_HITS = 1000
# The quadrature behind single scattering is exact for our purposes; what is allowed for our own float32.
SINGLE_SIGMA = 1e-4


@dataclass(frozen=True)
class Agreement:
    """How the rays of one atmosphere compare."""

    name: str
    rays: int
    left_out: int
    rms_z: float
    max_z: float
    bias: float
    bias_error: float
    relative_error: float
    seconds: float
    z: tuple[float, ...]


def agreement(
    name: str, mean: np.ndarray, error: np.ndarray, truth: np.ndarray, sigma: np.ndarray, **facts
) -> Agreement:
    """Compare means [N] and their standard errors with the truth and its sigma; ``facts``: left_out, seconds."""
    both = np.hypot(error, sigma)
    z = (mean - truth) / both
    weight = (truth / both) ** 2
    return Agreement(
        name=name,
        rays=len(z),
        rms_z=float(np.sqrt(np.mean(z**2))),
        max_z=float(np.max(np.abs(z))),
        bias=float(np.sum(weight * (mean / truth - 1.0)) / np.sum(weight)),
        bias_error=float(np.sum(weight) ** -0.5),
        relative_error=float(np.median(both / truth)),
        z=tuple(float(v) for v in z),
        **facts,
    )


def compare(
    samples: int,
    cases: Sequence[int] | None = None,
    *,
    single: bool = False,
    every: int = 1,
    seed: int = 1,
    integrator: str = "atmosphere_volpath",
) -> Iterator[Agreement]:
    """Path-trace the rays of ``sky_radiance.npz`` (every so-manyth of each case) in the variant that is set."""
    from atmo_jit.plugins.rays import PathTracedSky

    data = reference.load("sky_radiance")
    for index, case in enumerate(reference.sky_cases(data)):
        if cases is not None and index not in cases:
            continue
        started = time.perf_counter()
        take = np.arange(len(case.rows))[::every]
        views = {name: values[take] for name, values in case.views.items()}
        rows = case.rows[take]
        tracer = {"integrator": integrator, "max_depth": 2 if single else -1}
        mean, error, hits = PathTracedSky(case.atmosphere).radiance(
            views, samples, channel=case.channel[take], seed=seed + index, **tracer
        )
        truth, sigma = data["L"][rows], data["L_sigma"][rows]
        if single:
            truth = data["L_single"][rows] + data["L_ground_direct"][rows]
            sigma = SINGLE_SIGMA * truth
        known = hits >= LEAST_HITS
        yield agreement(
            case.name,
            mean[known],
            error[known],
            truth[known],
            sigma[known],
            left_out=int(np.sum(~known)),
            seconds=time.perf_counter() - started,
        )


def line(a: Agreement) -> str:
    """One line of the table."""
    return (
        f"{a.name:24s} {a.rays:3d} rays ({a.left_out} left out)  rms z {a.rms_z:.2f}  max {a.max_z:.1f}  "
        f"bias {100 * a.bias:+.3f} +- {100 * a.bias_error:.3f} %  median error {100 * a.relative_error:.2f} %  "
        f"{a.seconds:.1f} s"
    )


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("sky", "single", "efficiency"))
    parser.add_argument("--samples", type=int, default=100_000, help="paths for each ray and wavelength")
    parser.add_argument("--cases", type=int, nargs="*", help="indices of atmospheres (default: all 17)")
    parser.add_argument("--every", type=int, default=1, help="take every so-manyth ray")
    parser.add_argument("--integrator", default="atmosphere_volpath", help="volpath, volpathmis or prbvolpath")
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args(arguments)

    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb" if given.what == "efficiency" else "llvm_ad_mono")
    from atmo_jit.plugins import register

    register()
    if given.what == "efficiency":
        from .medium_efficiency import main as efficiency

        return efficiency(given.json)
    rows = []
    options = {"single": given.what == "single", "every": given.every, "integrator": given.integrator}
    for row in compare(given.samples, given.cases, **options):
        rows.append(row)
        if not given.json:
            print(line(row), flush=True)
    z = np.concatenate([row.z for row in rows])
    if given.json:
        print(json.dumps([asdict(row) for row in rows]))
    else:
        print(f"all {len(z)} rays: rms z {np.sqrt(np.mean(z**2)):.3f}, mean z {np.mean(z):+.3f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
