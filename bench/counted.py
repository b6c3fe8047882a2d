"""The command line of tests by the hundred: how often what happened, and a line for everything that was wrong."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable

from atmo_jit.progress import progress_bar

# (how many, seed, advance) -> how often what happened (labels, the outcome last), and what was wrong.
Tried = Callable[[int, int, Callable[[float], None]], tuple[Counter, list[str]]]


def command(module: str, about: str, what: str, default: int, tried: Tried) -> Callable[[], int]:
    """The ``main`` of a module with the docstring ``about``: runs ``tried`` as often as ``--count`` says, prints what
    came of it, and returns an exit status, 1 where something was wrong. ``what``: is tried, in the plural."""

    def main() -> int:
        parser = argparse.ArgumentParser(prog=f"python -m {module}", description=about.partition("\n")[0])
        parser.add_argument("--count", type=int, default=default, help="default: %(default)s")
        parser.add_argument("--seed", type=int, default=0, help="default: %(default)s")
        options = parser.parse_args()
        with progress_bar(what) as advance:
            found, wrong = tried(options.count, options.seed, advance)
        for labels, count in sorted(found.items()):
            print(f"{': '.join(labels)}: {count}")
        print("\n".join(wrong))
        print(f"{options.count} {what}, {len(wrong)} wrong")
        return int(bool(wrong))

    return main
