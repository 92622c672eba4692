"""Sweep configs: what a TOML file may say, and messages that name the file, the key, what came and what is allowed."""

import hashlib
import itertools
import json
import random
import tomllib
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, get_args

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, FiniteFloat, ValidationError, ValidationInfo, field_validator
from pydantic_core import ErrorDetails

from experiments import _layouts, _rows, methods
from experiments._commands import MOST_SEED
from experiments._errors import UsageError

Positive = Annotated[FiniteFloat, Field(gt=0)]
Timeout = Annotated[FiniteFloat, Field(gt=0, le=1e6)]  # [s]; the system waits no longer than some weeks
Fill = Annotated[FiniteFloat, Field(gt=0, le=1)]
Seed = Annotated[int, Field(ge=0, le=MOST_SEED)]
Dtype = Literal["float32", "float64"]
LIMITS = ("most_seconds", "timeout")  # when a row is given up, not what it measures


class Table(BaseModel):
    """A table of a config: keys that it does not know are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)


def one_of(kind: str, names: Callable[[], Iterable[str]], is_one: Callable[[str], bool] | None = None) -> AfterValidator:
    """Return what refuses a name that is none of a kind; a ValueError says which there are."""

    def check(name: str) -> str:
        if not (name in names() if is_one is None else is_one(name)):
            raise ValueError(f"unknown {kind} {name!r}; allowed: {', '.join(names())}")
        return name

    return AfterValidator(check)


MethodName = Annotated[str, one_of("method", methods.names)]
LayoutName = Annotated[str, one_of("layout", _layouts.names, _layouts.is_layout)]


class Scenes(Table):
    """Every layout at every fill and whatever else is given several times; without fills, each layout at its own."""

    layouts: tuple[LayoutName, ...] = Field(min_length=1)
    """Where particles are: `python -m experiments list` names all, `show LAYOUT` draws one."""
    fills: tuple[Fill, ...] = ()
    """Shares of the full domain; without them, each layout has its own."""
    spacings: tuple[Positive, ...] = ()
    """Instead of the config's spacing [m]."""
    cutoff_ratios: tuple[Positive, ...] = ()
    """Instead of the config's cutoff_ratio."""
    seeds: tuple[Seed, ...] = ()
    """Instead of the config's seed."""
    angles: tuple[FiniteFloat, ...] = ()
    """Of turnedN and cutN [degrees]."""
    growths: tuple[Annotated[FiniteFloat, Field(ge=1)], ...] = ()
    """Of grownN: how many times larger the domain becomes."""
    orders: tuple[Literal["layout", "shuffled", "sorted"], ...] = ()
    """Of the particles: as the layout has them, shuffled, or sorted by cells of a cutoff."""
    motions: tuple[Annotated[FiniteFloat, Field(ge=0)], ...] = ()
    """How far every particle goes between two searches, for methods that follow motion [spacings]."""

    def scenes(self) -> Iterator[dict[str, Any]]:
        """Yield what each scene says, as fields of a `Spec`; what is not given is left out."""
        axes = {"layout": self.layouts, "fill": self.fills or (None,)}
        more = ("spacings", "cutoff_ratios", "seeds", "angles", "growths", "orders", "motions")
        axes |= {name.removesuffix("s"): getattr(self, name) for name in more if getattr(self, name)}
        for values in itertools.product(*axes.values()):
            yield dict(zip(axes, values, strict=True))


class Repeats(Table):
    """How often something is timed."""

    repeats: Annotated[int, Field(ge=1)] = 5
    """Fewest timed runs in a process."""
    min_seconds: Annotated[FiniteFloat, Field(ge=0)] = 0.5
    """Runs go on until they took this long together [s], or until there are max_repeats."""
    max_repeats: Annotated[int, Field(ge=1)] = 50
    """Most timed runs in a process; 1: the first run is the only one."""
    timeout: Timeout = 300.0
    """A row's process is ended after this time [s]."""

    @field_validator("max_repeats")
    @classmethod
    def _max_is_no_less(cls, most: int, info: ValidationInfo) -> int:
        if most < (fewest := info.data.get("repeats", 1)):
            raise ValueError(f"got {most}; it must not be less than repeats, {fewest}")
        return most


class Config(Repeats):
    """A sweep: scenes × methods, and how each row is measured."""

    methods: tuple[MethodName, ...] = Field(min_length=1)
    """What is compared: `python -m experiments list` names all; a file of experiments/methods each."""
    scenes: tuple[Scenes, ...] = Field(min_length=1)
    """Tables [[scenes]], one after another."""
    processes: Annotated[int, Field(ge=1)] = 1
    """Every row is measured in so many, each in a round of its own over all scenes."""
    spacing: Positive = 1e-4
    """Distance of lattice neighbors [m]."""
    cutoff_ratio: Positive = 3.0
    """Cutoff in spacings."""
    dtype: Dtype = "float32"
    """Of the positions."""
    dim: Literal[2, 3] = 3
    """Dimensions."""
    seed: Seed = 0
    """Of random layouts."""
    most_seconds: Positive = 60.0
    """No run begins when they took this long together, be they as few as they may [s]. Where a later sweep allows more, rows with
    too few repeats are measured again."""

    @property
    def hash(self) -> str:
        """Digest of all that the config says, 12 hex digits."""
        return digest(self.model_dump())

    def specs(self) -> Iterator["Spec"]:
        """Yield the rows of the sweep, each once, in rounds: drift of the machine meets all scenes and methods alike.

        The first round goes as the config does, the others each in a random order, the methods of a scene side by side.
        """
        shared = self.model_dump(exclude={"methods", "scenes", "processes"})
        scenes = list(dict.fromkeys(tuple(scene.items()) for table in self.scenes for scene in table.scenes()))
        for process in range(self.processes):
            order = random.Random(process)
            for scene in scenes if process == 0 else order.sample(scenes, len(scenes)):
                methods = self.methods if process == 0 else order.sample(self.methods, len(self.methods))
                for method in dict.fromkeys(methods):
                    yield Spec(**shared | dict(scene) | {"method": method, "process": process})


@dataclass(frozen=True)
class Spec:
    """What one row measures: a scene, a method, and how to measure it."""

    layout: str
    fill: float | None
    method: str
    spacing: float
    cutoff_ratio: float
    dtype: str
    dim: int
    seed: int
    repeats: int
    min_seconds: float
    max_repeats: int
    most_seconds: float
    timeout: float
    process: int = 0
    angle: float | None = None
    growth: float | None = None
    order: str = "layout"
    motion: float = 0.0

    @property
    def scene_name(self) -> str:
        """Layout and fill in words, such as `corners 11 %`."""
        return _rows.name_scene(self.layout, self.fill)

    @property
    def scene_key(self) -> tuple:
        """What decides the positions and the cutoff."""
        return (self.layout, self.fill, *(getattr(self, name) for name in _rows.SCENE_FIELDS))

    @property
    def key(self) -> str:
        """Digest of all fields but the limits of time, 12 hex digits: a row with the same key need not run again, unless cut short.

        A row that no limit cut short would be the same under any other.
        """
        return digest({name: value for name, value in asdict(self).items() if name not in LIMITS})

    def is_cut_short(self, row: _rows.SearchRow) -> bool:
        """Whether a row has fewer repeats than asked, where `most_seconds` would have let another begin."""
        return row.status == "ok" and len(row.seconds) < self.repeats and sum(row.seconds) < self.most_seconds


def narrow(config: Config, **asked: Any) -> Config:  # noqa: ANN401
    """Return a config with other methods, layouts, fills and so on, where they are not None; refuse what is not allowed.

    Layouts have the fills that the config gives them, their own where it names them nowhere, or those that are asked for.
    """
    asked = {name: value for name, value in asked.items() if value is not None}
    layouts, fills = asked.pop("layouts", None), asked.pop("fills", None)
    tables = [table.model_dump() for table in config.scenes]
    if layouts is not None:
        there = {name: [table for table in tables if name in table["layouts"]] or [{}] for name in layouts}
        tables = [table | {"layouts": (name,)} for name, found in there.items() for table in found]
    if fills is not None:
        tables = [table | {"fills": fills} for table in tables]
    try:
        return Config.model_validate(config.model_dump() | asked | {"scenes": tables})
    except ValidationError as error:
        raise UsageError("\n".join(_tell(error, Config))) from error


def digest(value: object) -> str:
    """Return 12 hex digits that stand for a value of JSON."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:12]


ConfigT = TypeVar("ConfigT", bound=Table)


def load(path: Path, kind: type[ConfigT] = Config) -> ConfigT:
    """Read and check a config, by default that of a sweep; each mistake in it is a line of a `UsageError`."""
    try:
        return kind.model_validate(tomllib.loads(path.read_text(encoding="utf-8")))
    except OSError as error:
        raise UsageError(f"{path}: cannot be read ({error.strerror}); expected a TOML file") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise UsageError(f"{path}: no valid TOML: {error}") from error
    except ValidationError as error:
        raise UsageError("\n".join(f"{path}: {line}" for line in _tell(error, kind))) from error


def _tell(error: ValidationError, kind: type[Table]) -> list[str]:
    """Return a line for each key that is wrong."""
    items = error.errors()  # of a list whose only item is wrong, it also says that the list is empty
    items = [item for item in items if not any(item["loc"] == other["loc"][: len(item["loc"])] != other["loc"] for other in items)]
    return [_explain(item, kind) for item in items]


def _table_of(kind: type[BaseModel], location: Sequence[int | str]) -> type[BaseModel]:
    """Return the table of a config that stands at a place."""
    for part in location:
        inside = _tables_in(kind.model_fields[part].annotation) if isinstance(part, str) else []
        kind = inside[0] if inside else kind
    return kind


def _tables_in(annotation: Any) -> list[type[BaseModel]]:  # noqa: ANN401
    """Return the tables that an annotation names, however deep."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [table for part in get_args(annotation) for table in _tables_in(part)]


def _explain(item: ErrorDetails, kind: type[Table]) -> str:
    """Say in one line which key is wrong, what came, and what is allowed."""
    location = item["loc"]
    key = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in location).lstrip(".")
    if item["type"] == "extra_forbidden":
        return f"{key}: unknown key (value {item['input']!r}); allowed: {', '.join(_table_of(kind, location[:-1]).model_fields)}"
    if item["type"] == "missing":
        return f"{key}: missing; it must be given"
    if item["type"] == "value_error":
        return f"{key}: {item.get('ctx', {}).get('error')}"
    said = {"tuple_type": "input should be a list", "too_short": "the list should not be empty"}.get(item["type"], item["msg"])
    return f"{key}: got {item['input']!r}; {said[0].lower()}{said[1:]}"
