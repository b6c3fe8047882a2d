"""``atmo-jit bench``: run time against error of every method and setting on this machine."""

from __future__ import annotations

import json
from contextlib import ExitStack
from importlib.util import find_spec
from pathlib import Path

import click

from atmo_jit.errors import InputError
from atmo_jit.files import atomic_outputs, check_folder, check_output
from atmo_jit.progress import progress_bar

PARTS = ("frontier", "stages", "peers", "curves")


@click.command()
@click.option("--out", required=True, type=click.Path(path_type=Path), help="Folder for bench.json, .png and .md.")
@click.option("--reference", type=click.Path(path_type=Path), help="Folder that holds sky_radiance.npz.")
@click.option("--atmosphere", default="earth", show_default=True, metavar="FILE|NAME", help="The one that is timed.")
@click.option("--method", "methods", multiple=True, metavar="NAME", help="Only these methods (repeatable).")
@click.option("--part", "parts", multiple=True, type=click.Choice(PARTS), help="Only these parts (repeatable).")
@click.option("--views", "most_views", default=10**6, show_default=True, type=click.IntRange(100, 10**8),
              help="Largest number of views on the curve, e.g. 10000000.")  # fmt: skip
@click.option("--quick", is_flag=True, help="The settings that say most, smaller sizes: under a minute.")
@click.option("--quiet", is_flag=True, help="No progress bar and no summary.")
def command(
    out: Path,
    reference: Path | None,
    atmosphere: str,
    methods: tuple[str, ...],
    parts: tuple[str, ...],
    most_views: int,
    quick: bool,
    quiet: bool,
) -> None:
    """Run time against error for every method and setting, with the peers that are installed.

    \b
    Writes bench.json (its fields: see the module atmo_jit.bench.frontier), bench.png (needs matplotlib: install
    atmo-jit[bench]) and bench.md into a folder. Errors are measured against reference data, --reference or those
    beside the repository; without any against this package's own highest resolution, and the output says so.
    """
    from atmo_jit.atmosphere import Atmosphere
    from atmo_jit.bench import frontier
    from atmo_jit.bench.frontier_page import page, summary
    from atmo_jit.bench.methods import method_of

    for name in methods:
        method_of(name)
    Atmosphere.load(atmosphere)
    check_folder(out)
    if not out.exists() and not out.parent.is_dir():
        raise InputError(f"--out {str(out)!r}: there is no folder {str(out.parent)!r}")
    drawn = find_spec("matplotlib") is not None
    names = ["bench.json", "bench.md"] + ["bench.png"] * drawn
    if out.exists():
        for name in names:
            check_output(out / name, Path(name).suffix)
    with progress_bar("measuring", quiet=quiet) as advance:
        result = frontier.measure(
            reference=reference,
            atmosphere=atmosphere,
            methods=methods or None,
            parts=parts or PARTS,
            quick=quick,
            most_views=most_views,
            advance=advance,
        )
    if not drawn:
        reason = "matplotlib is not installed: pip install 'atmo-jit[bench]'"
        result["skipped"].append({"what": "bench.png", "reason": reason})
    out.mkdir(exist_ok=True)
    with ExitStack() as stack:
        temporary = stack.enter_context(atomic_outputs(*(check_output(out / n, Path(n).suffix) for n in names)))
        temporary[0].write_text(json.dumps(result, indent=1, allow_nan=False) + "\n", encoding="utf-8")
        temporary[1].write_text(page(result, "bench.png" if drawn else None), encoding="utf-8")
        if drawn:
            from atmo_jit.bench.figure import draw

            draw(result, temporary[2])
    if not quiet:
        click.echo(summary(result))
        click.echo(f"{out}: {', '.join(names)}; {result['seconds']:.0f} s")
