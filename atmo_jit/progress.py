"""One progress bar for every command: on a terminal, on stderr, never in a pipe or a log.

    with progress_bar("rendering", quiet=False) as advance:
        for step in range(10):
            ...
            advance((step + 1) / 10)

The bar needs rich, which is imported only where a bar is shown.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

Advance = Callable[[float], None]


@contextmanager
def progress_bar(text: str, *, quiet: bool = False) -> Iterator[Advance]:
    """Show a bar while the block runs; the block calls what it gets with the fraction done, 0 to 1.

    The bar disappears at the end of the block, also when that is an exception. With ``quiet``, or where stderr is not a
    terminal, nothing is shown and the calls cost nothing.
    """
    if quiet or not sys.stderr.isatty():
        yield lambda fraction: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task(text, total=1.0)
        yield lambda fraction: progress.update(task, completed=min(max(fraction, 0.0), 1.0))
