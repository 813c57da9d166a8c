"""Runs a command until the process that started this one ends. A program of its own, so that it outlives that process."""

import os
import signal
import subprocess
import sys
import threading

#: How often to look whether the parent lives, in seconds.
PARENT_CHECK_S = 1.0


def main() -> int:
    parent, is_over = os.getppid(), threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: is_over.set())
    process = subprocess.Popen(sys.argv[1:], stdin=subprocess.DEVNULL)

    def watch_the_pipe() -> None:
        while os.read(sys.stdin.fileno(), 1024):
            pass
        is_over.set()

    def end_with_the_parent() -> None:
        # Children that the parent forked keep the pipe open, also after it has ended.
        while not is_over.wait(PARENT_CHECK_S) and os.getppid() == parent:
            pass
        process.terminate()

    for work in (watch_the_pipe, end_with_the_parent):
        threading.Thread(target=work, daemon=True).start()
    return process.wait()


if __name__ == "__main__":
    sys.exit(main())
