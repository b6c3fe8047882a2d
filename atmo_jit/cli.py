"""The command ``atmo-jit``: finds the subcommand, runs it, and turns what it raises into one line and an exit status.

Status 0: done. 2: bad usage or bad input (:class:`~atmo_jit.errors.InputError`, click's usage errors). 130:
interrupted by Ctrl-C or SIGTERM. 1: anything else; ``--debug`` or ``ATMO_JIT_DEBUG=1`` then shows the traceback.
"""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module

import click

from . import __version__
from .errors import InputError, LLVMError, OutputError, one_line
from .interrupts import interrupted_by_signals
from .llvm import missing_library

# Each is the click command named `command` of the module atmo_jit.commands.<name>, imported only when it is used.
COMMANDS = {
    "sky": "Radiance, transmittance and irradiance for a list of views.",
    "render": "Render a Mitsuba scene to a linear OpenEXR and a PNG.",
    "export": "Tables of an atmosphere that other programs load.",
    "fit": "Fit an atmosphere to measured sky radiance.",
    "plan": "What a scene or views need: what is built or skipped, and its cost.",
    "bench": "Run time against error of every method and peer on this machine.",
    "view": "The sky in a browser, while sliders change the air.",
    "info": "Versions, the LLVM library in use, the atmospheres that come along.",
}


@dataclass
class _Settings:
    debug: bool = False


class _LazyGroup(click.Group):
    """A group whose commands are the entries of COMMANDS."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, name: str) -> click.Command | None:
        return import_module(f".commands.{name}", __package__).command if name in COMMANDS else None

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl(list(COMMANDS.items()))


@click.group(cls=_LazyGroup, no_args_is_help=False, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="atmo-jit")
@click.option("--debug", is_flag=True, help="Show the traceback of an error (also: ATMO_JIT_DEBUG=1).")
@click.pass_obj
def group(settings: _Settings, debug: bool) -> None:
    """Light in planetary atmospheres: skies, pictures, tables and fits, all differentiable."""
    settings.debug = settings.debug or debug


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line (``sys.argv`` if no ``arguments`` are given) and return its exit status."""
    # Closed by the shell (>&-): what is written there is for nobody.
    sys.stdout, sys.stderr = (stream or open(os.devnull, "w") for stream in (sys.stdout, sys.stderr))
    settings = _Settings(debug=os.environ.get("ATMO_JIT_DEBUG", "0") not in ("", "0"))
    with interrupted_by_signals() as interrupt:
        try:
            status = group.main(arguments, prog_name="atmo-jit", standalone_mode=False, obj=settings)
            sys.stdout.flush()
            return status if isinstance(status, int) else 0
        except (Exception, KeyboardInterrupt) as error:
            # Within a library's own code an interrupt may have become another exception.
            if interrupt.asked or isinstance(error, KeyboardInterrupt | click.Abort):
                return _fail("interrupted", 130, settings)
            return _failed(error, settings)


def _failed(error: Exception, settings: _Settings) -> int:
    if isinstance(error, BrokenPipeError):
        # The reader of our output went away (`atmo-jit info | head`): nothing to say, and nobody to say it to.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    if isinstance(error, click.ClickException):
        return _fail(error.format_message(), 2, settings)
    if isinstance(error, InputError | LLVMError | OutputError):
        return _fail(str(error), 2 if isinstance(error, InputError) else 1, settings)
    text = missing_library(error) or f"{type(error).__name__}: {error} (atmo-jit --debug shows where)"
    return _fail(text, 1, settings)


def _fail(text: str, status: int, settings: _Settings) -> int:
    if settings.debug:
        traceback.print_exc()
    print(f"atmo-jit: {one_line(text)}", file=sys.stderr)
    return status
