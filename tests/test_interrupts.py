"""Signals that wait until the work at hand is whole."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time

import pytest

from atmo_jit.interrupts import deferred_interrupts, interrupted_by_signals, uninterrupted


@pytest.fixture(autouse=True)
def interruptible():
    """Jobs that a shell starts in the background ignore interrupts."""
    former = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, former)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_first_signal_waits_and_second_raises(number):
    before = signal.getsignal(number)
    with deferred_interrupts() as interrupt:
        assert not interrupt.asked
        os.kill(os.getpid(), number)
        assert interrupt.asked
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), number)
    assert signal.getsignal(number) is before


def test_ignored_signals_stay_ignored():
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with deferred_interrupts() as interrupt:
        os.kill(os.getpid(), signal.SIGINT)
    assert not interrupt.asked


def test_other_threads_just_run():
    seen = []

    def work():
        with deferred_interrupts() as interrupt:
            seen.append(interrupt.asked)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [False]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_end_commands_and_wait_for_what_must_be_whole(number):
    before, done = signal.getsignal(number), []
    with pytest.raises(KeyboardInterrupt), interrupted_by_signals() as interrupt:
        with uninterrupted():
            os.kill(os.getpid(), number)
            done.append(interrupt.asked)
        done.append("never")
    assert done == [False] and interrupt.asked and signal.getsignal(number) is before


def test_what_waits_is_sent_on_to_a_block_that_waits_too():
    with deferred_interrupts() as interrupt:
        with uninterrupted():
            os.kill(os.getpid(), signal.SIGTERM)
            assert not interrupt.asked
        assert interrupt.asked


def test_imports_are_whole_before_an_interrupt(tmp_path, monkeypatch):
    # Extension modules that see an exception while they are set up may abort the process.
    name = "atmo_jit_imported_by_a_test"
    (tmp_path / f"{name}.py").write_text(
        "import os, signal, time\nos.kill(os.getpid(), signal.SIGTERM)\ntime.sleep(0.05)\nwhole = True\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(KeyboardInterrupt), interrupted_by_signals():
        __import__(name)
        time.sleep(10)
    assert sys.modules.pop(name).whole


def test_a_late_interrupt_of_what_is_done_is_forgotten(tmp_path, monkeypatch):
    name = "atmo_jit_imported_last_by_a_test"
    (tmp_path / f"{name}.py").write_text("import os, signal\nos.kill(os.getpid(), signal.SIGINT)\n")
    monkeypatch.syspath_prepend(tmp_path)
    with interrupted_by_signals() as interrupt:
        __import__(name)
    time.sleep(0.05)
    assert interrupt.asked and sys.modules.pop(name)
