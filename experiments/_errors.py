"""The one error that a user can cause."""


class UsageError(Exception):
    """A mistake in a command, a config or a folder of rows. Its message is shown without a traceback, and the exit code is 2."""
