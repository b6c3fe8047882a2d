"""``atmo-jit plan``: what will be built for a scene or a list of views, what is skipped and why, and what it costs."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from atmo_jit.errors import InputError

if TYPE_CHECKING:
    from atmo_jit.plan import Plan

RUNS = 4  # of a plan that is checked: a solve is recorded when it is asked for again


@click.command()
@click.argument("scene", required=False)
@click.option("--atmosphere", metavar="FILE|NAME", help="Atmosphere JSON file or preset name (with --views).")
@click.option("--views", type=click.Path(path_type=Path), help="NPZ file with the views, as for atmo-jit sky.")
@click.option("--tolerance", type=float, default=0.01, show_default=True, help="Relative error to aim for, in (0, 1).")
@click.option("--orders", type=click.IntRange(min=1), help="Scattering and reflection events, as for atmo-jit sky.")
@click.option("--free", metavar="NAME,...", help="Dotted names of the values whose derivatives are wanted.")
@click.option("--no-ground", is_flag=True, help="Leave out the ground's own radiance.")
@click.option("--sun-disc", is_flag=True, help="The sun's disc is wanted in views that meet it.")
@click.option("-D", "definitions", multiple=True, metavar="NAME=VALUE", help="A parameter of the scene (repeatable).")
@click.option("--variant", default="llvm_ad_rgb", show_default=True, help="Mitsuba variant that reads the scene.")
@click.option("--check", is_flag=True, help="Run it, and compare with what was predicted.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
def command(
    scene: str | None,
    atmosphere: str | None,
    views: Path | None,
    tolerance: float,
    orders: int | None,
    free: str | None,
    no_ground: bool,
    sun_disc: bool,
    definitions: tuple[str, ...],
    variant: str,
    check: bool,
    as_json: bool,
) -> None:
    """What will be built for SCENE (a file or a shipped scene's name), or for --atmosphere and --views.

    Seconds are CPU seconds with compiled kernels, MiB are beyond imports, the error is the 95th percentile.
    """
    if (scene is None) == (atmosphere is None and views is None):
        raise InputError("give either SCENE, or --atmosphere and --views")
    names = tuple(name.strip() for name in free.split(",") if name.strip()) if free else ()
    if scene is not None:
        made, asked = _of_scene(scene, definitions, variant, tolerance, names)
    else:
        if atmosphere is None or views is None:
            raise InputError(f"--{'atmosphere' if atmosphere is None else 'views'} is missing; a plan needs both")
        if definitions:
            raise InputError(f"-D {definitions[0]}: only a scene has parameters")
        made, asked = _of_views(atmosphere, views, tolerance, orders, names, not no_ground, sun_disc)
    result: dict[str, Any] = made.to_dict()
    if check:
        result["check"] = checked(made, asked)
    click.echo(json.dumps(result, indent=1) if as_json else "\n".join(_text(made, result)))


def _of_views(
    atmosphere: str, views: Path, tolerance: float, orders: int | None, free: tuple[str, ...], ground: bool, disc: bool
) -> tuple[Plan, dict[str, Any]]:
    from atmo_jit.atmosphere import Atmosphere
    from atmo_jit.needs import Needs
    from atmo_jit.plan import plan
    from atmo_jit.views import load_views

    air, rays = Atmosphere.load(atmosphere), load_views(views)
    needs = Needs.of_views(air, rays, sun_disc=disc, free=free)
    made = plan(air, needs, tolerance=tolerance, orders=orders, ground=ground)
    return made, {"views": rays, "ground": ground, "sun_disc": disc}


def _of_scene(
    scene: str, definitions: tuple[str, ...], variant: str, tolerance: float, free: tuple[str, ...]
) -> tuple[Plan, dict[str, Any]]:
    from atmo_jit.commands.render import _mitsuba, _parameters
    from atmo_jit.needs import Needs
    from atmo_jit.plan import plan
    from atmo_jit.scenes import find

    path, parameters = find(scene), _parameters(definitions)
    with _mitsuba(variant):
        from atmo_jit.plugins.needs import needs_of_scene
        from atmo_jit.scenes.reader import load_scene

        found = needs_of_scene(lambda edit: load_scene(path, parameters, edit=edit))
    given = found.settings
    lit = given.sun_scale > 0.0
    needs = Needs.of_observer(
        given.atmosphere, given.altitude_m, found.sun_zenith_deg, disc=lit, free=free, seen=found.sees_sun
    )
    made = plan(given.atmosphere, needs, tolerance=tolerance)
    return made, {"observer": (given.altitude_m, found.sun_zenith_deg)}


def checked(made: Plan, asked: dict[str, Any]) -> dict[str, Any]:
    """Run a plan: seconds, MiB, and a line for each prediction that was off by more than a factor of two.

    It is run RUNS times, and the last one is measured: kernels are then compiled, and the solve recorded.
    """
    import resource

    import numpy as np

    from atmo_jit.backend import floats
    from atmo_jit.plan import compared, error_found

    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for _ in range(RUNS):
        start = time.process_time()
        sky = made.solve()
        _finish(sky.irradiance(floats([0.0]), floats(np.radians(made.needs.suns_deg[:1]))))
        solve = time.process_time() - start
        start = time.process_time()
        _evaluate(made, sky, asked)
        views = time.process_time() - start
    mib = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024.0
    predicted, error = made.predicted, error_found(made, _seen(asked))
    notes = (
        compared(predicted.solve_cpu_s, solve, "solve", "CPU s"),
        compared(predicted.views_cpu_s, views, "views", "CPU s"),
        compared(predicted.mib, mib, "memory", "MiB"),
        # What is found is a part of the error: that it is less says nothing.
        compared(predicted.error_percent, max(error, predicted.error_percent), "error", "%"),
    )
    found = {"solve_cpu_s": solve, "views_cpu_s": views, "mib": mib, "error_percent": error}
    return {**found, "notes": [note for note in notes if note]}


def _seen(asked: dict[str, Any]) -> dict[str, Any]:
    """The views that a plan is for; an observer looks anywhere."""
    import numpy as np

    from atmo_jit.views import check_views

    if "views" in asked:
        return asked["views"]
    altitude, zenith = asked["observer"]
    rng = np.random.default_rng(0)
    seen = {"view_zenith_deg": np.degrees(np.arccos(rng.uniform(-1, 1, 500))), "azimuth_deg": rng.uniform(0, 180, 500)}
    return check_views({"altitude_m": altitude, "sun_zenith_deg": zenith, **seen})


def _evaluate(made: Plan, sky: Any, asked: dict[str, Any]) -> None:
    """The rays that the plan marches."""
    import numpy as np

    from atmo_jit.backend import doubles
    from atmo_jit.costs import VIEWS_AT_ONCE

    if "observer" in asked:
        from atmo_jit.plugins.panorama import Panorama, solve_sky

        altitude, zenith = asked["observer"]
        air = made.atmosphere
        panorama = Panorama.of(air.bottom_radius_m, air.thickness_m, altitude, float(np.radians(zenith)))
        _finish(solve_sky(sky, panorama))
        return
    rays = asked["views"]
    for first in range(0, len(rays["altitude_m"]), VIEWS_AT_ONCE):
        part = {name: values[first : first + VIEWS_AT_ONCE] for name, values in rays.items()}
        angles = [doubles(np.radians(part[name])) for name in ("sun_zenith_deg", "view_zenith_deg", "azimuth_deg")]
        distance = doubles(part["distance_m"]) if "distance_m" in part else None
        light = sky.rays(
            doubles(part["altitude_m"]), *angles, distance, ground=asked["ground"], sun_disc=asked["sun_disc"]
        )
        _finish((light.radiance, light.transmittance))


def _finish(values: Any) -> None:
    import drjit as dr

    dr.eval(values)
    dr.sync_thread()


def _text(made: Plan, result: dict[str, Any]) -> list[str]:
    lines = []
    for item in made.items:
        if item.built:
            lines.append(f"{item.name:26} {item.size:48} {item.reason}")
        else:
            what = f"{item.name} ({item.size})" if item.size else item.name
            lines.append(f"{what:26} {'skipped':48} {item.reason}")
    p = made.predicted
    lines.append(f"{'method':26} {made.method}")
    lines.append(
        f"{'predicted':26} solve {p.solve_cpu_s:.3g} + views {p.views_cpu_s:.3g} CPU s, {p.mib:.0f} MiB, "
        f"error {p.error_percent:.2g} %"
    )
    if "check" in result:
        found = result["check"]
        lines.append(
            f"{'found':26} solve {found['solve_cpu_s']:.3g} + views {found['views_cpu_s']:.3g} CPU s, "
            f"{found['mib']:.0f} MiB, at least {found['error_percent']:.2g} % error"
        )
        lines += found["notes"] or ["predictions were within a factor of two"]
    return lines
