"""Signals that wait until the work at hand is whole."""

from __future__ import annotations

import os
import signal
import threading

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
