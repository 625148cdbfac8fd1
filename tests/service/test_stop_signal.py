"""The order to stop is never missed: before the wait, in it, by another thread, and in the midst of something."""

import os
import signal
import threading
import time
from collections.abc import Iterator

import pytest

from seamark.service.stop_signal import StopSignal, StopSignalError


@pytest.fixture
def stop() -> Iterator[StopSignal]:
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
    yield StopSignal()
    signal.set_wakeup_fd(-1)
    for number, handler in before.items():
        signal.signal(number, handler)


def send(delay_s: float, number: int = signal.SIGTERM) -> None:
    time.sleep(delay_s)
    os.kill(os.getpid(), number)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
@pytest.mark.parametrize("delay_s", [0.0, 0.05])
def test_a_signal_ends_the_wait(stop: StopSignal, delay_s: float, number: int) -> None:
    assert not stop.wait(0.01) and not stop.ordered
    thread = threading.Thread(target=send, args=(delay_s, number))
    thread.start()
    assert stop.wait(10)
    thread.join()
    assert stop.ordered and stop.wait()  # also when it has come before


def test_a_signal_to_another_thread_ends_the_wait(stop: StopSignal) -> None:
    """Test: the kernel gives the signal to a thread that runs no handler. Expected: the main thread hears of it."""
    idle = threading.Thread(target=time.sleep, args=(0.5,))
    idle.start()
    assert idle.ident is not None
    threading.Timer(0.05, signal.pthread_kill, (idle.ident, signal.SIGTERM)).start()
    began = time.monotonic()
    assert stop.wait(10)
    assert time.monotonic() - began < 5
    idle.join()


def test_what_takes_long_is_given_up(stop: StopSignal) -> None:
    thread = threading.Thread(target=send, args=(0.05,))
    thread.start()
    with pytest.raises(StopSignalError):
        stop.interrupting(lambda: time.sleep(30))
    thread.join()
    with pytest.raises(StopSignalError):  # nothing is begun any more
        stop.interrupting(lambda: pytest.fail("made"))


def test_afterwards_a_signal_interrupts_nothing(stop: StopSignal) -> None:
    assert stop.interrupting(lambda: 5) == 5
    os.kill(os.getpid(), signal.SIGTERM)
    assert stop.wait(10)
