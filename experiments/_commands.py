"""What all commands share: how they are listed, options that are checked where they enter, and errors that fit into a line."""

import functools
import importlib
import math
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, ClassVar

import typer
from typer.core import TyperGroup

from experiments._errors import NoResultError, UsageError

MOST_POINTS = 100_000_000
MOST_SEED = 2**31 - 1


class Commands(TyperGroup):
    """Commands listed a line each; what is wrong with a command line is said in one line, with exit code 2.

    Attributes:
        there: Of commands that are imported when they are run: the module, whose function `command` returns what is printed, and
            what it does; where it is stopped, the same command goes on.
    """

    there: ClassVar[dict[str, tuple[str, str]]] = {}

    def list_commands(self, ctx: Any) -> list[str]:  # noqa: ANN401
        """Return the names, in the order in which they were written down."""
        return [*self.commands, *self.there]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:  # noqa: ANN401
        """Return a command, after importing it where that has to be."""
        if cmd_name not in self.there:
            return super().get_command(ctx, cmd_name)
        app = typer.Typer(add_completion=False, rich_markup_mode=None)
        app.command(name=cmd_name)(_make_command(importlib.import_module(self.there[cmd_name][0]).command))
        return typer.main.get_command(app)

    def format_help(self, ctx: Any, formatter: Any) -> None:  # noqa: ANN401
        """Write the list: less than the 24 lines of a screen."""
        formatter.write(f"Usage: {ctx.command_path} COMMAND ...   (COMMAND --help says more)\n")
        for name in self.list_commands(ctx):
            command: Any = self.commands.get(name)
            text = self.there[name][1] if command is None else command.get_short_help_str(66)
            formatter.write(f"  {name:<12}{text}\n")

    def main(self, args: Sequence[str] | None = None, *more: Any, standalone_mode: bool = True, **others: Any) -> Any:  # noqa: ANN401
        """Run, and say mistakes in a line."""
        if not standalone_mode:
            return super().main(args, *more, standalone_mode=False, **others)
        try:
            code = super().main(args, *more, standalone_mode=False, **others)
        except Exception as error:
            code = _report_error(error, sys.argv[1:] if args is None else args)
        sys.exit(code if isinstance(code, int) else 0)


def those_of(there: dict[str, tuple[str, str]]) -> type[Commands]:
    """Return what lists these commands, too."""
    return type("Those", (Commands,), {"there": there})


def _make_command(function: Callable[..., Any]) -> Callable[..., None]:
    """Return a command that prints what a function returns."""

    @functools.wraps(function)
    def command(*args: Any, **options: Any) -> None:  # noqa: ANN401
        with stoppable():
            typer.echo(function(*args, **options))

    return command


def _report_error(error: Exception, given: Sequence[str]) -> int:
    """Print a mistake, what cannot be read or written, or too little memory, and return the exit code; raise all else again."""
    if isinstance(error, typer.Abort):
        typer.echo("aborted", err=True)
        return 1
    if isinstance(error, UsageError | NoResultError | OSError | MemoryError):
        said = str(error)
        if isinstance(error, OSError):
            said = (f"{error.filename}: " if error.filename else "") + (error.strerror or said)
        elif isinstance(error, MemoryError):
            said = f"this takes more memory than there is; ask for fewer particles: {said}"
        typer.echo(f"error: {said}", err=True)
        return 1 if isinstance(error, NoResultError) else 2
    tell, context = getattr(error, "format_message", None), getattr(error, "ctx", None)
    if tell is None:
        raise error
    if type(error).__name__ == "NoArgsIsHelpError":
        typer.echo(context.get_help() if context else tell())
        return 0
    message, option = " ".join(tell().split()), _option_of(error, given)
    if option is not None:
        message = f"{option}: {message.partition(': ')[2] or message}"
    where = f" (see {context.command_path} --help)" if context else ""
    typer.echo(f"error: {message}{where}", err=True)
    return 2


def _option_of(error: Any, given: Sequence[str]) -> str | None:  # noqa: ANN401
    """Return the option whose value is refused, with that value, as it was given."""
    for name in getattr(getattr(error, "param", None), "opts", ()):
        for place, token in enumerate(given):
            if token.startswith(f"{name}="):
                return token.replace("=", " ", 1)
            if token == name and place + 1 < len(given):
                return f"{name} {given[place + 1]}"
    return None


def finite(value: Any) -> Any:  # noqa: ANN401
    """Refuse numbers that are none, or infinite: a range lets NaN through."""
    for number in value if isinstance(value, list | tuple) else [value]:
        if number is not None and not math.isfinite(number):
            raise typer.BadParameter(f"{number} is not a finite number.")
    return value


def positive(value: Any) -> Any:  # noqa: ANN401
    """Refuse numbers that are not finite or not above 0."""
    for number in finite(value) if isinstance(value, list | tuple) else [finite(value)]:
        if number is not None and not number > 0:
            raise typer.BadParameter(f"{number} is not in the range x>0.")
    return value


def _check_engine(value: str) -> str:
    check_choice("--backend", value, ("auto", "jax", "warp", "brute"))
    return value


def check_choice(option: str, value: str, allowed: Sequence[str]) -> None:
    """Refuse a word that an option does not know, naming the option and what is allowed."""
    if value not in allowed:
        raise UsageError(f"{option} {value}: allowed: {', '.join(allowed)}")


def check_names(kind: str, names: Sequence[str] | None, allowed: Iterable[str]) -> None:
    """Refuse names of what there is none of, naming the first of them, and what is allowed."""
    allowed = list(allowed)
    if unknown := [name for name in names or () if name not in allowed]:
        raise UsageError(f"no {kind} {unknown[0]!r}; allowed: {', '.join(allowed)}")


def check_ending(path: Path, allowed: Sequence[str]) -> None:
    """Refuse a file whose ending names no format; see `check_choice`."""
    if path.suffix not in allowed:
        raise UsageError(f"--out {path}: unknown ending {path.suffix!r}; allowed: {', '.join(allowed)}")


def take_folder(folder: Path, option: str = "--out") -> Path:
    """Make the folder that takes what a command writes, and return it; where that cannot be, the message names the option."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not os.access(folder, os.W_OK | os.X_OK):
            raise PermissionError(13, "Permission denied")
    except OSError as error:
        reason = "there is a file of that name" if isinstance(error, FileExistsError | NotADirectoryError) else error.strerror
        raise UsageError(f"{option} {folder}: cannot be written ({reason}); name a folder that can be") from error
    return folder


def take_file(path: Path, option: str = "--out") -> Path:
    """Make the folder of a file that a command writes, and return the file; see `take_folder`."""
    take_folder(path.parent, option)
    if path.is_dir() or (path.exists() and not os.access(path, os.W_OK)):
        reason = "there is a folder of that name" if path.is_dir() else "Permission denied"
        raise UsageError(f"{option} {path}: cannot be written ({reason}); name a file that can be")
    return path


@contextmanager
def stoppable() -> Iterator[None]:
    """Where the user stops what keeps its rows, say that the same command goes on, and exit with code 130."""
    try:
        yield
    except KeyboardInterrupt:
        typer.echo("stopped; the same command goes on from here", err=True)
        raise typer.Exit(130) from None


# --- options that several commands have -------------------------------------------------------------------------------------

Layout = Annotated[str, typer.Argument(help="Name of a layout, such as full, clusters2, corners.")]
Fill = Annotated[float | None, typer.Option(callback=finite, help="Share of the full domain, above 0 and up to 1.")]
Spacing = Annotated[float, typer.Option(min=1e-6, max=1.0, callback=finite, help="Distance of lattice neighbors [m].")]
Dim = Annotated[int, typer.Option(min=2, max=3, help="Dimensions.")]
Seed = Annotated[int, typer.Option(min=0, max=MOST_SEED, help="Seed of random layouts.")]
RetryFailed = Annotated[bool, typer.Option("--retry-failed", help="Measure missing, failed and timed-out rows again.")]
RowsFolder = Annotated[Path | None, typer.Option(help="Folder of the rows; out/NAME without it.")]
Points = Annotated[int, typer.Option(min=100, max=MOST_POINTS, help="Random points.")]
Rounds = Annotated[int, typer.Option(min=2, max=100_000, help="Timed runs of each.")]
Engine = Annotated[str, typer.Option(callback=_check_engine, help="As in jfrnn.search: auto, warp, jax or brute.")]
