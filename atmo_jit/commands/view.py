"""``atmo-jit view``: the sky of an atmosphere in a browser."""

from __future__ import annotations

import webbrowser
from typing import Any

import click

from atmo_jit.atmosphere import Atmosphere
from atmo_jit.errors import InputError
from atmo_jit.viewer.controls import check
from atmo_jit.viewer.server import HOST, Server


@click.command()
@click.option(
    "--atmosphere", default="earth", show_default=True, metavar="FILE|NAME", help="Atmosphere JSON file or preset name."
)
@click.option("--port", type=click.IntRange(0, 65535), default=0, help="Port on this machine (default: a free one).")
@click.option("--tolerance", type=float, default=0.01, show_default=True, help="Relative error to aim for, in (0, 1).")
@click.option("--no-browser", is_flag=True, help="Print the address and open nothing.")
def command(atmosphere: str, port: int, tolerance: float, no_browser: bool) -> None:
    """The sky in a browser, drawn from the tables of atmo-jit export while sliders change the air.

    Serves a page to this machine until it is interrupted; nothing leaves the machine.
    """
    if not 0.0 < tolerance < 1.0:
        raise InputError(f"--tolerance is {tolerance}; must be a number between 0 and 1")
    air = Atmosphere.load(atmosphere)
    check(air)

    def make() -> Any:
        from atmo_jit.viewer.live import Live  # imports Dr.Jit, while the browser starts

        return Live(air, atmosphere, tolerance)

    try:
        with Server(make, port) as server:
            address = f"http://{HOST}:{server.port}/"
            click.echo(f"{address} (Ctrl-C ends it)")
            if not no_browser:
                webbrowser.open(address)
            server.serve_forever(poll_interval=0.05)
    except KeyboardInterrupt:  # how it is meant to end
        click.echo("")
