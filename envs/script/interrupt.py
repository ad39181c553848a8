"""Ctrl-C that is acted on where the state is whole."""

import contextlib
import signal
import threading


@contextlib.contextmanager
def until_interrupted():
    """A list that stays empty until Ctrl-C; a second one kills. Outside of the main thread Ctrl-C is somebody else's."""
    pressed = []
    if threading.current_thread() is not threading.main_thread():
        yield pressed
        return

    def press(*_):
        pressed.append(True)
        signal.signal(signal.SIGINT, signal.SIG_DFL)

    previous = signal.signal(signal.SIGINT, press)
    try:
        yield pressed
    finally:
        signal.signal(signal.SIGINT, previous)
