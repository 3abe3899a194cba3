"""Where the program begins."""

from __future__ import annotations

import gc
import signal


def main() -> None:
    """Load the program and run it."""
    # While it loads there is no garbage; looking for it takes a twentieth of two pictures' mosaic.
    # `StopOnSignal`, with which the work begins, turns that on.
    gc.disable()
    # There is nothing to put away either: Ctrl-C just ends it. As an exception it would come out
    # of any line of any import, and be turned into another one there.
    is_ours = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if is_ours:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from streamtrack.cli import main as run

    if is_ours:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        run()
    finally:
        # What is left goes with the process: a last search for cycles takes a tenth of a second.
        gc.freeze()


if __name__ == "__main__":
    main()
