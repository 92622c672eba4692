"""Errors that are said in a line."""


class UsageError(Exception):
    """A mistake in a command, a config or a folder of rows. Its message is shown without a traceback, and the exit code is 2."""


class NoResultError(Exception):
    """No row that was asked for has a result. The message says why, and is shown without a traceback; the exit code is 1."""
