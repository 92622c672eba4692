"""Entry point of `python -m experiments`."""

from experiments._cli import app

app(prog_name="python -m experiments")
