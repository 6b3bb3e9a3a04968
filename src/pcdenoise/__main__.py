"""Where the process starts: `pcdenoise` and `python -m pcdenoise`. Not here: the commands, nor what errors become."""

import signal
import sys


def run() -> int:
    """The command line. Ctrl-C while Python still loads ends it without a word, and once the work is done is too late."""
    interruptible = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if interruptible:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from pcdenoise.commands import main

    if interruptible:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    code = main()
    if interruptible:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    return code


if __name__ == "__main__":
    sys.exit(run())
