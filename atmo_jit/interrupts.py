"""Ctrl-C and SIGTERM: one end for both, which waits where the work at hand must be whole."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

AGAIN_SECONDS = 0.01


class Interrupt:
    """``asked``: whether the user asked to stop."""

    asked = False


@contextmanager
def interrupted_by_signals() -> Iterator[Interrupt]:
    """In the block, Ctrl-C and SIGTERM raise KeyboardInterrupt, so that what has been begun is cleared away.

    What was asked is kept, because an exception that is raised within a library's own code may come out of it as
    another one. Where Python could only ignore it (in a destructor, or a callback of the garbage collector), and where
    a library could not take it (while a module is imported), it is raised a little later.
    """
    interrupt, ignored = Interrupt(), sys.unraisablehook
    last, later = signal.SIGINT, None

    def end(number: int, frame: FrameType | None) -> None:
        nonlocal last
        interrupt.asked, last = True, number
        if not _importing(frame):
            raise KeyboardInterrupt
        send_later()

    def send_later() -> None:
        nonlocal later
        later = threading.Timer(AGAIN_SECONDS, _send, (last,))
        later.daemon = True
        later.start()

    def again(lost: sys.UnraisableHookArgs) -> None:
        if interrupt.asked and issubclass(lost.exc_type, KeyboardInterrupt):
            send_later()
        elif not interrupt.asked:  # afterwards half-made objects complain that they are half-made
            ignored(lost)

    with _handled(end):
        sys.unraisablehook = again
        try:
            yield interrupt
        finally:
            sys.unraisablehook = ignored
            if later:  # what is done cannot be interrupted
                later.cancel()


@contextmanager
def uninterrupted() -> Iterator[None]:
    """In the block, the first Ctrl-C or SIGTERM waits for the end of the block, and is then sent again."""
    seen: list[int] = []

    def note(number: int, frame: FrameType | None) -> None:
        if seen:
            raise KeyboardInterrupt
        seen.append(number)

    try:
        with _handled(note):
            yield
    finally:
        for number in seen:
            signal.raise_signal(number)


@contextmanager
def deferred_interrupts() -> Iterator[Interrupt]:
    """In the block, the first Ctrl-C or SIGTERM is only noted, and the block stops where it can; the second raises.

    An exception in the midst of a traced loop would leave Dr.Jit half way through a kernel, and come out of it as
    another one.
    """
    interrupt = Interrupt()

    def note(number: int, frame: FrameType | None) -> None:
        if interrupt.asked:
            raise KeyboardInterrupt
        interrupt.asked = True

    with _handled(note):
        yield interrupt


@contextmanager
def _handled(handler: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    """``handler`` for Ctrl-C and SIGTERM; threads other than the main one get no signals: there the block just runs."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    # Ignored signals (a job that a shell put into the background) stay ignored.
    caught = [s for s in (signal.SIGINT, signal.SIGTERM) if signal.getsignal(s) != signal.SIG_IGN]
    former = {number: signal.signal(number, handler) for number in caught}
    try:
        yield
    finally:
        for number, before in former.items():
            signal.signal(number, before)


def _importing(frame: FrameType | None) -> bool:
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            return True
        frame = frame.f_back
    return False


def _send(number: int) -> None:
    """The signal to the main thread, which wakes it."""
    if hasattr(signal, "pthread_kill"):
        signal.pthread_kill(threading.main_thread().ident, number)
    else:
        signal.raise_signal(number)
