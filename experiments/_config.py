"""Sweep configs: what a TOML file may say, and messages that name the file, the key, what came and what is allowed."""

import hashlib
import json
import tomllib
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError, ValidationInfo, field_validator
from pydantic_core import ErrorDetails

from experiments import _layouts, methods
from experiments._errors import UsageError

Positive = Annotated[FiniteFloat, Field(gt=0)]
Fill = Annotated[FiniteFloat, Field(gt=0, le=1)]


class Table(BaseModel):
    """A table of a config: keys that it does not know are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class Scenes(Table):
    """Every layout at every fill; without fills, each layout at its own."""

    layouts: tuple[str, ...] = Field(min_length=1)
    fills: tuple[Fill, ...] = ()

    @field_validator("layouts")
    @classmethod
    def _layouts_exist(cls, layouts: tuple[str, ...]) -> tuple[str, ...]:
        for layout in layouts:
            if not _layouts.is_layout(layout):
                raise ValueError(f"unknown layout {layout!r}; allowed: {', '.join(_layouts.names())}")
        return layouts


class Config(Table):
    """A sweep: scenes × methods, and how each row is measured.

    Attributes:
        methods: Names of adapters, one file each in experiments/methods.
        scenes: Tables of layouts × fills.
        spacing: Distance of lattice neighbors [m].
        cutoff_ratio: Cutoff in spacings.
        dtype: Precision of the positions.
        dim: 2 or 3.
        seed: Seed of random layouts.
        repeats: Fewest timed runs of a row.
        min_seconds: Runs go on until they took this long together [s].
        max_repeats: Most timed runs of a row.
        timeout: A row's process is ended after this time [s].
    """

    methods: tuple[str, ...] = Field(min_length=1)
    scenes: tuple[Scenes, ...] = Field(min_length=1)
    spacing: Positive = 1e-4
    cutoff_ratio: Positive = 3.0
    dtype: Literal["float32", "float64"] = "float32"
    dim: Literal[2, 3] = 3
    seed: Annotated[int, Field(ge=0)] = 0
    repeats: Annotated[int, Field(ge=1)] = 5
    min_seconds: Annotated[FiniteFloat, Field(ge=0)] = 0.5
    max_repeats: Annotated[int, Field(ge=1)] = 50
    timeout: Positive = 300.0

    @field_validator("methods")
    @classmethod
    def _methods_exist(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        for name in names:
            if name not in methods.names():
                raise ValueError(f"unknown method {name!r}; allowed: {', '.join(methods.names())}")
        return names

    @field_validator("max_repeats")
    @classmethod
    def _max_is_no_less(cls, most: int, info: ValidationInfo) -> int:
        if most < (fewest := info.data.get("repeats", 1)):
            raise ValueError(f"got {most}; it must not be less than repeats, {fewest}")
        return most

    @property
    def hash(self) -> str:
        """Digest of all that the config says, 12 hex digits."""
        return digest(self.model_dump())

    def specs(self) -> Iterator["Spec"]:
        """Yield the rows of the sweep, the methods of one scene side by side, each row once."""
        shared = self.model_dump(exclude={"methods", "scenes"})
        seen = set()
        for table in self.scenes:
            pairs = ((layout, fill) for layout in table.layouts for fill in table.fills or (None,))
            for layout, fill in pairs:
                for method in self.methods:
                    spec = Spec(layout=layout, fill=fill, method=method, **shared)
                    if spec.key not in seen:
                        seen.add(spec.key)
                        yield spec


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
    timeout: float

    @property
    def scene_name(self) -> str:
        """Layout and fill in words, such as `corners 11 %`."""
        return self.layout if self.fill is None else f"{self.layout} {100 * self.fill:g} %"

    @property
    def scene_key(self) -> tuple:
        """What decides the positions and the cutoff."""
        return (self.layout, self.fill, self.spacing, self.cutoff_ratio, self.dtype, self.dim, self.seed)

    @property
    def key(self) -> str:
        """Digest of all fields, 12 hex digits: a row with the same key need not run again."""
        return digest(asdict(self))


def digest(value: object) -> str:
    """Return 12 hex digits that stand for a value of JSON."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:12]


ConfigT = TypeVar("ConfigT", bound=Table)


def load(path: Path, kind: type[ConfigT] = Config) -> ConfigT:
    """Read and check a config, by default that of a sweep.

    Raises:
        UsageError: The file cannot be read, is no TOML, or says something that is not allowed.
    """
    try:
        return kind.model_validate(tomllib.loads(path.read_text(encoding="utf-8")))
    except OSError as error:
        raise UsageError(f"{path}: cannot be read ({error.strerror}); expected a TOML file") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise UsageError(f"{path}: no valid TOML: {error}") from error
    except ValidationError as error:
        raise UsageError("\n".join(f"{path}: {_explain(item, kind)}" for item in error.errors())) from error


def _explain(item: ErrorDetails, kind: type[Table]) -> str:
    """Say in one line which key is wrong, what came, and what is allowed."""
    location = item["loc"]
    key = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in location).lstrip(".")
    if item["type"] == "extra_forbidden":
        table = Scenes if location[0] == "scenes" and len(location) > 1 else kind
        return f"{key}: unknown key (value {item['input']!r}); allowed: {', '.join(table.model_fields)}"
    if item["type"] == "missing":
        return f"{key}: missing; it must be given"
    if item["type"] == "value_error":
        return f"{key}: {item.get('ctx', {}).get('error')}"
    return f"{key}: got {item['input']!r}; {item['msg'][0].lower()}{item['msg'][1:]}"
