"""What the user sees of a run while it goes on: one line that is written over on a terminal, else a line for each moment."""

import sys
from typing import TextIO


class Progress:
    """Say how many of the moments of a run are there."""

    def __init__(self, total: int, done: int, stream: TextIO | None = None) -> None:
        """Begin with those that are there already."""
        self._total, self._done, self._stream, self._wide = total, done, stream or sys.stderr, 0

    def advance(self, text: str) -> None:
        """Say that one more is there, and a text beside it."""
        self._done += 1
        line = f"{self._done}/{self._total} {text}"
        if self._stream.isatty():
            self._stream.write("\r" + line.ljust(self._wide))
            self._wide = len(line)
        else:
            self._stream.write(line + "\n")
        self._stream.flush()

    def end(self) -> None:
        """Leave the line on a terminal."""
        if self._wide:
            self._stream.write("\n")
