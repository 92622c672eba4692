"""Commands of `python -m experiments`, run in the process of a test: what they say, and what they refuse."""

from typer.testing import CliRunner

from experiments._cli import app


def invoke(*words, **environment):
    """Run a command; return its exit code, and what it says on standard output and error. What it does not catch is raised."""
    given = {"prog_name": "python -m experiments", "env": environment, "catch_exceptions": False}
    result = CliRunner().invoke(app, list(map(str, words)), **given)
    return result.exit_code, result.stdout, result.stderr


def told(*words, **environment):
    """Run a command that ends well; return what it says on standard output."""
    code, out, err = invoke(*words, **environment)
    assert code == 0, out + err
    return out


def refused(*words, by=invoke):
    """Run a command that is refused; return what it says, a line, without the "error: "."""
    code, out, err = by(*words)
    assert (code, out, err[:7], err.count("\n")) == (2, "", "error: ", 1), out + err
    return err.removeprefix("error: ").rstrip("\n")
