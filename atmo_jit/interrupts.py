"""Ctrl-C and SIGTERM that wait until the work at hand is whole."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


class Interrupt:
    """``asked``: whether the user asked to stop."""

    asked = False


@contextmanager
def deferred_interrupts() -> Iterator[Interrupt]:
    """In the block, the first Ctrl-C or SIGTERM is only noted, and the block stops where it can; the second raises.

    An exception in the midst of a traced loop would leave Dr.Jit half way through a kernel, and come out of it as
    another one. Threads other than the main one get no signals: there the block just runs.
    """
    interrupt = Interrupt()
    if threading.current_thread() is not threading.main_thread():
        yield interrupt
        return

    def note(number: int, frame: FrameType | None) -> None:
        if interrupt.asked:
            raise KeyboardInterrupt
        interrupt.asked = True

    # Ignored signals (a job that a shell put into the background) stay ignored.
    caught = [s for s in (signal.SIGINT, signal.SIGTERM) if signal.getsignal(s) != signal.SIG_IGN]
    former = {number: signal.signal(number, note) for number in caught}
    try:
        yield interrupt
    finally:
        for number, handler in former.items():
            signal.signal(number, handler)
