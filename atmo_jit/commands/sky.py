"""``atmo-jit sky``: radiance, transmittance and irradiance for a list of views, from and to NPZ files."""

from __future__ import annotations

import json
from pathlib import Path

import click
import numpy as np

from atmo_jit.atmosphere import Atmosphere
from atmo_jit.errors import InputError
from atmo_jit.files import atomic_outputs, check_output, write_npz
from atmo_jit.progress import progress_bar
from atmo_jit.views import load_views


@click.command()
@click.option("--atmosphere", required=True, metavar="FILE|NAME", help="Atmosphere JSON file or preset name.")
@click.option("--views", required=True, type=click.Path(path_type=Path), help="NPZ file with the views.")
@click.option("--out", required=True, type=click.Path(path_type=Path), help="NPZ file to write.")
@click.option("--tolerance", type=float, default=0.01, show_default=True, help="Relative error to aim for, in (0, 1).")
@click.option(
    "--orders", type=click.IntRange(min=1), help="Scattering and reflection events; 1 = single scattering only."
)
@click.option("--method", type=click.Choice(["auto", "tables", "march"]), default="auto", show_default=True)
@click.option("--gradient", metavar="NAME,...", default="", help="Parameters by which to differentiate the radiance.")
@click.option("--no-ground", is_flag=True, help="Leave out the ground's own radiance.")
@click.option("--sun-disc", is_flag=True, help="Add the sun's disc to views that meet it.")
@click.option("--refraction", is_flag=True, help="Views have the sun's true place; the air lifts it.")
@click.option("--quiet", is_flag=True, help="No progress bar and no summary.")
def command(
    atmosphere: str,
    views: Path,
    out: Path,
    tolerance: float,
    orders: int | None,
    method: str,
    gradient: str,
    no_ground: bool,
    sun_disc: bool,
    refraction: bool,
    quiet: bool,
) -> None:
    """Sky radiance for every view in an NPZ file.

    \b
    VIEWS.npz: 1-D arrays of one length N: altitude_m, sun_zenith_deg, view_zenith_deg, azimuth_deg (view minus sun),
    and distance_m where rays stop early (inf: no stop).
    OUT.npz: radiance, transmittance, sun_irradiance, sky_irradiance, float32 [N, wavelengths], and meta (JSON text).
    
    With --gradient also d_radiance/NAME for a number and dlog_radiance/NAME for a list (by the logarithm of a common
    factor); NAME is any dotted name of the atmosphere, or an array of the views.
    """
    if not 0.0 < tolerance < 1.0:  # also refuses NaN
        raise InputError(f"--tolerance is {tolerance}; must be a number between 0 and 1")
    path = check_output(out, ".npz")
    air = Atmosphere.load(atmosphere)
    rays = load_views(views)
    if refraction:
        from atmo_jit.refraction import lift

        zenith = np.radians(rays["sun_zenith_deg"])
        rays["sun_zenith_deg"] = np.degrees(zenith - lift(air, zenith, rays["altitude_m"]))

    from atmo_jit.sky import sky  # after the input is known to be good: this imports Dr.Jit

    with progress_bar("sky", quiet=quiet) as advance:
        result = sky(
            air,
            rays,
            tolerance=tolerance,
            orders=orders,
            ground=not no_ground,
            sun_disc=sun_disc,
            method=method,
            gradient=[name.strip() for name in gradient.split(",") if name.strip()],
            progress=advance,
        )
    arrays = {
        name: np.asarray(getattr(result, name), dtype=np.float32)
        for name in ("radiance", "transmittance", "sun_irradiance", "sky_irradiance")
    }
    arrays |= result.gradient
    with atomic_outputs(path) as (part,):
        write_npz(part, arrays | {"meta": np.array(json.dumps(result.meta))})
    if not quiet:
        count, bands = arrays["radiance"].shape
        click.echo(f"{out}: {count} views, {bands} wavelengths, {result.meta['seconds']:.2f} s")
