"""``atmo-jit fit``: an atmosphere from measured sky radiance."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import click

from atmo_jit.files import atomic_outputs, check_output
from atmo_jit.progress import progress_bar


@click.command()
@click.option(
    "--observations", required=True, type=click.Path(path_type=Path), help="NPZ, CSV or EXR file with the radiance."
)
@click.option("--config", required=True, type=click.Path(path_type=Path), help="TOML file: what is free, and how.")
@click.option("--out", required=True, type=click.Path(path_type=Path), help="JSON to write; a .png goes beside it.")
@click.option("--resume", is_flag=True, help="Go on from what an interrupted run kept.")
@click.option("--quiet", is_flag=True, help="No progress bar and no summary.")
def command(observations: Path, config: Path, out: Path, resume: bool, quiet: bool) -> None:
    """Fit values of an atmosphere to measured sky radiance.

    \b
    OBSERVATIONS: radiance [N, W], sigma or relative_sigma, wavelengths_nm, altitude_m, sun_zenith_deg,
    view_zenith_deg, and azimuth_deg or sun_azimuth_deg with view_azimuth_deg; or a fisheye or lat-long picture.
    RESULT.json: values, standard errors, intervals, covariance, residuals, and what the data cannot tell.

    A fit that ends early leaves RESULT.partial.json, from which --resume goes on.
    """
    json_path, png_path = check_output(out, ".json"), check_output(out.with_suffix(".png"), ".png")

    from atmo_jit.fits.config import FitConfig
    from atmo_jit.fits.observations import load_observations

    settings = FitConfig.load(config)
    if observations.suffix.lower() == ".exr":
        from atmo_jit.fits.pictures import load_picture

        data = load_picture(observations, settings)
    else:
        data = load_observations(observations)

    from atmo_jit.fits.figure import draw  # after the input is known to be good: this imports Dr.Jit
    from atmo_jit.fits.fit import fit
    from atmo_jit.fits.kept import KeptFit
    from atmo_jit.fits.result import result

    kept = KeptFit(json_path, data, settings)
    begun = kept.begin(resume, _warn)
    with kept.until_done(_warn):
        with progress_bar("fitting", quiet=quiet) as advance:
            found = fit(data, settings, advance, kept.keep, begun)
        report = result(found)
        with atomic_outputs(json_path, png_path) as (json_part, png_part):
            json_part.write_text(json.dumps(report, indent=1, allow_nan=False) + "\n", encoding="utf-8")
            draw(found, report, png_part)
    if not quiet:
        _print(report, out, data.unused)


def _print(report: dict[str, Any], out: Path, unused: tuple[str, ...]) -> None:
    for name, entry in (report["parameters"] | report["nuisance"]).items():
        several = isinstance(entry["value"], list)
        for value, (low, high), bound in zip(
            *([entry[key] if several else [entry[key]] for key in ("value", "interval_95_model_error", "at_bound")]),
            strict=True,
        ):
            click.echo(f"{name:<34} {value:>10.4g}   95 %: {low:.4g} to {high:.4g}{'   at its bound' if bound else ''}")
    for sentence in report["not_identifiable"]:
        click.echo(sentence)
    if unused:
        click.echo(f"not used: {', '.join(unused)}")
    done = "converged" if report["converged"] else "NOT converged"
    click.echo(
        f"{out}: {done}, {report['reason']}; {report['samples']} samples, {report['iterations']} iterations, "
        f"residual {report['residual_rms']:.3g} rms, {report['residual_robust']:.3g} robust, {report['seconds']:.2f} s"
    )


def _warn(text: str) -> None:
    print(f"atmo-jit: warning: {text}", file=sys.stderr)
