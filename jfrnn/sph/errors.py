"""What goes wrong by the user's hand, or in a run; the command line says it in one line and ends with exit code 2."""


class SceneError(ValueError):
    """A scene, one of its settings, or a file that it is made of cannot be used; the message says which, and what to do."""


class DivergedError(RuntimeError):
    """A run went wrong; the message says in which step, and which particle."""
