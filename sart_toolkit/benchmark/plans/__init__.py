"""Plans of benchmarks: a grid of cells each, from a name in `PLANS` or a person's TOML file."""

from __future__ import annotations

import dataclasses
import fnmatch
import itertools
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import msgspec

from sart_toolkit.backends import DEFAULT_BACKEND
from sart_toolkit.errors import BrokenFile, InvalidInput, MissingFile, unknown_name

PLANS = (
    "success",
    "table1",
    "scaling",
    "ablation",
    "miles_radii",
    "effort",
    "transfer",
    "recordings",
    "placement",
    "robustness",
    "precision",
)
# The stages of a cell, in order.
STAGES = ("record", "suggest", "augment", "train", "evaluate")
Options = dict[str, Any]


@dataclass(frozen=True)
class PlanCell:
    """One skill and how it is evaluated: all that decides the outcome of its rollouts.

    `task`, `backend`, `strategy`, `policy`: names or references; `evaluate_on`: the backend of the
    rollouts, where it is another. `n`: trajectories, the strategy's own number if None.
    `demonstration_seed`: of the demonstrations and of what is generated from them;
    `training_seed`: of the training. `episodes` rollouts have placements drawn from `eval_seed`.
    `device`: where training and policy run. Tables of further options: `recording` of
    `pipeline.record`, `suggestion` of `SuggestConfig`, `generation` of `AugmentConfig`, `training`
    of `TrainConfig`, `variation` of `EvaluateConfig`; a `label` in one of them is what tables call
    it. `until`: the last stage, "augment" where only effort is asked for.
    """

    task: str
    backend: str = DEFAULT_BACKEND
    evaluate_on: str | None = None
    strategy: str = "sart"
    n: int | None = None
    policy: str | None = None
    demonstration_seed: int = 0
    training_seed: int = 0
    episodes: int = 50
    eval_seed: int = 1000
    device: Literal["auto", "cpu", "cuda"] = "cpu"
    image_size: int = 128
    recording: Options = field(default_factory=dict)
    suggestion: Options = field(default_factory=dict)
    generation: Options = field(default_factory=dict)
    training: Options = field(default_factory=dict)
    variation: Options = field(default_factory=dict)
    until: Literal["augment", "evaluate"] = "evaluate"

    def shown(self, name: str) -> str:
        """A field's value as tables call it."""
        value = getattr(self, name)
        if name == "evaluate_on":
            value = value or self.backend
        if isinstance(value, Mapping):
            return str(value.get("label") or ", ".join(f"{k} {v}" for k, v in value.items()) or "-")
        if value is None:
            return "own"
        # Of a reference, what it names.
        return str(value).rpartition(":")[2]

    @property
    def name(self) -> str:
        """What it is called in files and on the page, by what plans usually vary."""
        parts = [self.shown("task"), self.backend]
        if self.evaluate_on not in (None, self.backend):
            parts.append(f"on_{self.evaluate_on}")
        parts.append(self.shown("strategy"))
        parts += [f"n{self.n}"] * (self.n is not None)
        parts += [self.shown("policy")] * (self.policy is not None)
        parts += [f"d{self.demonstration_seed}", f"t{self.training_seed}"]
        tables = ("recording", "suggestion", "generation", "training", "variation")
        parts += [self.shown(name) for name in tables if getattr(self, name)]
        kept = (c if c.isalnum() or c in "_.+±-" else "_" for c in "-".join(parts))
        return "".join(kept)

    def to_json(self) -> dict[str, Any]:
        """The cell as JSON values."""
        return dataclasses.asdict(self)


FIELDS = tuple(f.name for f in dataclasses.fields(PlanCell))


@dataclass(frozen=True)
class Plan:
    """A benchmark: its cells, and how tables show them.

    `rows`, `columns`: the fields of cells that a table has for rows and columns; each column is
    compared with the column `reference`, where there is one. What else differs between cells,
    seeds aside, makes tables of their own.
    """

    name: str
    about: str
    cells: tuple[PlanCell, ...]
    rows: str = "task"
    columns: str = "strategy"
    reference: str | None = None

    def __post_init__(self) -> None:
        for axis in (self.rows, self.columns):
            if axis not in FIELDS:
                raise unknown_name("field of a cell", axis, FIELDS)
        if self.rows == self.columns:
            raise InvalidInput(f"columns: expected another field than rows, got {self.columns!r}")
        names = [cell.name for cell in self.cells]
        if not names:
            raise InvalidInput(f"plan {self.name!r}: has no cell; add a [[grid]] with a task")
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice is not None:
            raise InvalidInput(
                f"plan {self.name!r}: two cells are called {twice!r}; leave one out, or give their "
                "tables of options different labels"
            )
        columns = {cell.shown(self.columns) for cell in self.cells}
        if self.reference is not None and self.reference not in columns:
            raise unknown_name(f"reference among {self.columns}", self.reference, columns)

    def only(self, pattern: str) -> Plan:
        """The plan with only the cells whose name matches a pattern such as `peg*-d101-*`.

        Raises:
            UnknownName: no cell matches.
        """
        cells = tuple(cell for cell in self.cells if fnmatch.fnmatch(cell.name, pattern))
        if not cells:
            raise unknown_name("cell", pattern, (cell.name for cell in self.cells))
        left = {cell.shown(self.columns) for cell in cells}
        reference = self.reference if self.reference in left else None
        return dataclasses.replace(self, cells=cells, reference=reference)


def read_plan(plan: str | Path, changes: Mapping[str, Any] | None = None) -> Plan:
    """The plan of a name in `PLANS`, or in a TOML file.

    Args:
        plan: the name, or the file's path, which ends with `.toml`.
        changes: values of fields, or lists of them, in place of the grids' own; what only some
            grids give is changed in those.

    Raises:
        UnknownName: no such plan, field or column.
        MissingFile, BrokenFile: the file can't be read.
        InvalidInput: a value is not acceptable, or two cells have one name.
    """
    if not str(plan).endswith(".toml"):
        if plan not in PLANS:
            raise unknown_name("benchmark", str(plan), PLANS)
        plan = Path(__file__).with_name(f"{plan}.toml")
    path = Path(plan)
    try:
        value = tomllib.loads(path.read_text())
    except FileNotFoundError as error:
        raise MissingFile(f"{path}: no such plan; pass a TOML file, or one of {PLANS}") from error
    except (OSError, ValueError) as error:
        raise BrokenFile(f"{path}: not readable as TOML ({error}); fix it") from error
    known = ("about", "rows", "columns", "reference", "grid")
    for key in value:
        if key not in known:
            raise unknown_name(f"{path.name}: entry", key, known)
    grids = value.pop("grid", [])
    if not isinstance(grids, list) or not all(isinstance(grid, dict) for grid in grids):
        raise InvalidInput(f"{path.name}: expected [[grid]] tables, got {grids!r}")
    given = {name for grid in grids for name in grid}
    cells = []
    for grid in grids:
        new = {k: v for k, v in (changes or {}).items() if k in grid or k not in given}
        cells += list(_cells(path.name, {**grid, **new}))
    # What is changed may make cells of two grids the same.
    unique = {msgspec.json.encode(cell.to_json()): cell for cell in cells}
    if any(not isinstance(text, str) for text in value.values()):
        raise InvalidInput(f"{path.name}: expected text for {', '.join(value)}")
    return Plan(path.stem, **{"about": "", **value}, cells=tuple(unique.values()))


def _cells(where: str, grid: Mapping[str, Any]) -> Iterator[PlanCell]:
    """Every combination of a grid's values."""
    for name in grid:
        if name not in FIELDS:
            raise unknown_name(f"{where}: field of a cell", name, FIELDS)
    axes: list[Sequence[Any]] = [v if isinstance(v, list) else [v] for v in grid.values()]
    for values in itertools.product(*axes):
        try:
            yield msgspec.convert(dict(zip(grid, values, strict=True)), PlanCell)
        except msgspec.ValidationError as error:
            raise InvalidInput(f"{where}: a grid's value is wrong or missing: {error}") from error
