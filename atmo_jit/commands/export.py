"""``atmo-jit export``: tables of an atmosphere that other programs load."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from atmo_jit.errors import InputError, shown
from atmo_jit.export import LAYOUTS, PRECISIONS, TEXELS, Options, export
from atmo_jit.progress import progress_bar


@click.command()
@click.option("--atmosphere", required=True, metavar="FILE|NAME", help="Atmosphere JSON file or preset name.")
@click.option("--layout", required=True, type=click.Choice(LAYOUTS), help="Who is to read them.")
@click.option("--out", required=True, type=click.Path(path_type=Path), help="Folder to write to.")
@click.option("--mu-s-min", type=float, help="Cosine of the lowest sun of the scattering table.")
@click.option("--size", metavar="AxBxC", help="Texels of the largest table, where the layout allows a choice.")
@click.option("--precision", type=click.Choice(PRECISIONS), help="Of the texels, where the layout allows both.")
@click.option(
    "--colour",
    type=click.Choice(["samples", "spectral"]),
    help="Channels: the atmosphere's three wavelengths, or linear sRGB from all of them.",
)
@click.option(
    "--texels",
    type=click.Choice(TEXELS),
    help="fitted: least error between the suns (default of takram and its like); exact: right at their centres.",
)
@click.option("--tolerance", type=float, default=0.01, show_default=True, help="Relative error to aim for, in (0, 1).")
@click.option("--orders", type=click.IntRange(min=1), help="Scattering and reflection events, as for atmo-jit sky.")
@click.option("--altitude", "altitude_m", type=float, help="Observer of tables for one of them (hillaire), m.")
@click.option("--sun", "sun_zenith_deg", type=float, help="Sun's zenith angle of tables for one of them (hillaire).")
@click.option("--quiet", is_flag=True, help="No progress bar and no summary.")
def command(
    atmosphere: str,
    layout: str,
    out: Path,
    mu_s_min: float | None,
    size: str | None,
    precision: str | None,
    colour: str | None,
    texels: str | None,
    tolerance: float,
    orders: int | None,
    altitude_m: float | None,
    sun_zenith_deg: float | None,
    quiet: bool,
) -> None:
    """Tables that a client loads unmodified, with a params.json beside them.

    Every file is read back before it gets its name. The error estimate in params.json compares these very tables with
    the solution that they were made from.
    """
    options = Options(mu_s_min, _size(size), precision, colour, tolerance, orders, altitude_m, sun_zenith_deg, texels)
    with progress_bar("export", quiet=quiet) as advance:
        report = export(atmosphere, layout, out, options, advance)
    for warning in report.warnings:
        print(f"atmo-jit: warning: {warning}", file=sys.stderr)
    if quiet:
        return
    seconds = sum(report.seconds.values())
    click.echo(f"{out}: {len(report.files)} files, {report.nbytes / 2**20:.1f} MiB, {seconds:.2f} s")
    for name, error in report.error.items():
        click.echo(
            f"  {name}: error of radiance against the solution: median {100 * error['median']:.3g} %, "
            f"p99 {100 * error['p99']:.3g} %"
        )


def _size(text: str | None) -> tuple[int, ...] | None:
    if text is None:
        return None
    parts = text.lower().split("x")
    if not all(p.isascii() and p.isdigit() and len(p) < 7 for p in parts):
        raise InputError(f"--size is {shown(text)}; must be whole numbers joined by x, as in 32x128x8x32")
    return tuple(map(int, parts))
