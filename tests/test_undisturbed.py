"""Signals wait until the end of a stretch that they must not split, and none is forgotten."""

import os
import signal
import threading

import pytest

from stagectl.undisturbed import undisturbed


def test_ctrl_c_waits_for_the_end():
    done = []
    with pytest.raises(KeyboardInterrupt):  # noqa: PT012 - the point is what runs before it
        with undisturbed():
            os.kill(os.getpid(), signal.SIGINT)
            done.append("rest of the stretch")
        done.append("never")
    assert done == ["rest of the stretch"]


def test_handlers_of_the_program_are_called_later_and_put_back():
    heard = []
    before = signal.signal(signal.SIGALRM, lambda number, frame: heard.append(number))
    try:
        mine = signal.getsignal(signal.SIGALRM)
        with undisturbed():
            os.kill(os.getpid(), signal.SIGALRM)
            assert heard == []
        assert heard == [signal.SIGALRM]
        assert signal.getsignal(signal.SIGALRM) is mine
    finally:
        signal.signal(signal.SIGALRM, before)


def test_an_error_inside_passes_and_handlers_are_put_back():
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(ValueError, match="inside"), undisturbed():
        raise ValueError("inside")
    assert signal.getsignal(signal.SIGINT) is before


def test_another_thread_is_left_alone():
    """Only the main thread may set handlers; elsewhere the stretch runs as it is."""
    done = []

    def work():
        with undisturbed():
            done.append(signal.getsignal(signal.SIGINT))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert done == [signal.getsignal(signal.SIGINT)]
