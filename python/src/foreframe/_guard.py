"""Runs a command until standard input closes. A program of its own, so that it outlives the process that started it."""

import os
import subprocess
import sys
import threading


def main() -> int:
    process = subprocess.Popen(sys.argv[1:], stdin=subprocess.DEVNULL)

    def end_with_the_pipe() -> None:
        while os.read(sys.stdin.fileno(), 1024):
            pass
        process.terminate()

    threading.Thread(target=end_with_the_pipe, daemon=True).start()
    return process.wait()


if __name__ == "__main__":
    sys.exit(main())
