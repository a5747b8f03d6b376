"""One small file for each run: what was run, on what, and what came out of it.

A record stands at ``FOLDER/METHOD/seed_S.json``. Reading is strict: whatever is missing, cut,
foreign, not finite or inconsistent is an error that names the file and the field.
"""

from __future__ import annotations

import itertools
import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from cnfp_torchrl.whole_file import whole_file

RETURN, PROCESSOR, VIOLATIONS = "train/return", "train/processor_seconds", "violations/"
"""Names of curves; the last is followed by the constraint's."""

Count = Annotated[int, Field(ge=0)]
Text = Annotated[str, Field(min_length=1)]


class RecordError(ValueError):
    """A file is not what it should be."""


class Kept(BaseModel):
    """Values kept as a JSON file, read strictly: exact types, finite numbers, no further fields."""

    model_config = ConfigDict(strict=True, frozen=True, extra="forbid", allow_inf_nan=False)

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read a file.

        Raises:
            RecordError: naming the file, every bad field, what was expected and what was given.
        """
        try:
            return cls.model_validate_json(path.read_bytes())
        except ValidationError as error:
            raise RecordError(f"{path}: {'; '.join(map(_in_words, error.errors()))}") from None
        except OSError as error:
            raise RecordError(f"{path}: {error.strerror}") from None


class Series(Kept):
    """A scalar over training.

    Args:
        steps: The environment steps since the start, strictly rising.
        values: One for each of the steps.
    """

    steps: Annotated[tuple[Count, ...], Field(min_length=1)]
    values: tuple[float, ...]

    @model_validator(mode="after")
    def _fit(self) -> Self:
        if len(self.steps) != len(self.values):
            given = f"{len(self.values)} values and {len(self.steps)} steps"
            raise ValueError(f"expected as many values as steps, given {given}")
        if any(a >= b for a, b in itertools.pairwise(self.steps)):
            raise ValueError("expected steps that rise")
        return self


class Outcome(Kept):
    """What a policy did in whole episodes.

    Args:
        return_mean: The mean undiscounted return of an episode.
        return_standard_error: The standard error of that mean.
        score: The mean return on the task's scale.
        violations: Violating steps by constraint, all episodes together.
        episodes: The number of episodes.
        steps: The environment steps, all episodes together.
    """

    return_mean: float
    return_standard_error: float
    score: float
    violations: dict[str, Count]
    episodes: Count
    steps: Count

    @classmethod
    def of(cls, report: Mapping[str, Any]) -> Self:
        """Return what is kept of an evaluation's report, which says more."""
        return cls(**{name: report[name] for name in cls.model_fields})


class Evaluation(Kept):
    """What a trained policy did with drawn actions, and with the mode of its distribution."""

    stochastic: Outcome
    deterministic: Outcome

    @property
    def both(self) -> tuple[Outcome, Outcome]:
        """Both outcomes."""
        return self.stochastic, self.deterministic


class Record(Kept):
    """One finished run.

    Args:
        format: What kind of file this is.
        version: The version of that format.
        method: The name of its experiment, a file of ``conf/experiment``.
        seed: The seed of everything random.
        overrides: What was given to the trainer beside experiment and seed.
        config: The training configuration, every interpolation resolved.
        versions: The versions of Python and of the packages that decide the numbers.
        commit: The commit of the repository, None where it is not known.
        steps: The environment steps of training.
        seconds: The wall time of training and evaluation; runs beside it slow it down.
        curves: Logged scalars by name: return, cumulative violations of each constraint, processor
            seconds, and whatever else the method logs.
        training_violations: Violating steps by constraint while training.
        evaluation: The evaluation of the trained policy.
        afterwards: The same policy after a change of the task that it was not trained for, by the
            change's name; empty where that was not evaluated.
    """

    format: Literal["cnfp_torchrl paper record"] = "cnfp_torchrl paper record"
    version: Literal[1] = 1
    method: Text
    seed: Count
    overrides: tuple[Text, ...]
    config: dict[str, Any]
    versions: dict[str, str]
    commit: str | None
    steps: Count
    seconds: float
    curves: dict[str, Series]
    training_violations: dict[str, Count]
    evaluation: Evaluation
    afterwards: dict[str, Evaluation]

    @property
    def constraints(self) -> tuple[str, ...]:
        """Names of the constraints, in the order of the costs."""
        return tuple(self.training_violations)

    @property
    def violations(self) -> int:
        """Violating steps in training and both evaluations, all constraints together."""
        counts = [
            self.training_violations,
            *(evaluation.violations for evaluation in self.evaluation.both),
        ]
        return sum(sum(count.values()) for count in counts)

    def save(self, folder: Path) -> Path:
        """Write the record into a folder of records, complete or not at all, and return its path.

        Raises:
            FileExistsError: when something stands there already.
        """
        path = record_path(folder, self.method, self.seed)
        path.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(path, exclusive=True) as file:
            file.write(f"{self.model_dump_json()}\n".encode())
        return path

    @model_validator(mode="after")
    def _fit(self) -> Self:
        """Refuse what contradicts itself."""
        if (given := self.config.get("seed")) != self.seed:
            raise ValueError(f"config.seed: expected {self.seed} as in 'seed', given {given!r}")
        needed = [RETURN, PROCESSOR, *(VIOLATIONS + name for name in self.constraints)]
        if missing := [name for name in needed if name not in self.curves]:
            raise ValueError(f"curves: expected {needed}, but {missing} are missing")
        for name, series in self.curves.items():
            if (last := series.steps[-1]) > self.steps:
                raise ValueError(
                    f"curves.{name}.steps: expected at most {self.steps}, given {last}"
                )
        for name, count in self.training_violations.items():
            values = self.curves[VIOLATIONS + name].values
            if any(a > b for a, b in itertools.pairwise(values)) or values[-1] != count:
                raise ValueError(
                    f"curves.{VIOLATIONS}{name}.values: expected counts that never fall and end at "
                    f"{count}, given {values[-1]} last"
                )
        for name, evaluation in {"evaluation": self.evaluation, **self.afterwards}.items():
            for outcome in evaluation.both:
                if (found := tuple(outcome.violations)) != self.constraints:
                    raise ValueError(
                        f"{name}: violations: expected the constraints {list(self.constraints)}, "
                        f"given {list(found)}"
                    )
        return self


class HostileRun(Kept):
    """One hostile network behind one flow.

    Args:
        flow: The name of the flow's configuration.
        network: The name of the network.
        steps: The environment steps.
        violations: Violating steps by constraint.
    """

    model_config = ConfigDict(extra="ignore")

    flow: Text
    network: Text
    steps: Count
    violations: dict[str, Count]


class HostileRuns(Kept):
    """What ``experiments/hostile_networks.py`` keeps, as far as the report shows it."""

    model_config = ConfigDict(extra="ignore")

    rows: Annotated[tuple[HostileRun, ...], Field(min_length=1)]

    def by_flow(self) -> dict[str, list[HostileRun]]:
        """Return the runs of each flow, in the order in which flows first appear."""
        return {
            flow: [r for r in self.rows if r.flow == flow] for flow in (r.flow for r in self.rows)
        }


def record_path(folder: Path, method: str, seed: int) -> Path:
    """Return where the record of a run stands in a folder of records."""
    return folder / method / f"seed_{seed}.json"


def load_records(folder: Path) -> tuple[list[Record], list[str]]:
    """Read a folder of records; what is wrong is named and left out, never averaged.

    Runs of one method are comparable when only their seeds differ: of several configurations the
    most frequent is kept. A seed that one method has and another lacks is named too.

    Returns:
        the usable records by method and seed, and a sentence for each problem.
    """
    found, problems = [], []
    for path in sorted(path for path in folder.rglob("*") if not path.is_dir()):
        try:
            record = Record.read(path)
        except RecordError as error:
            problems.append(f"{error} (left out)")
            continue
        if record_path(folder, record.method, record.seed) == path:
            found.append(record)
        else:
            problems.append(
                f"{path}: expected a record of the run that the path names, given "
                f"{record.method!r}, seed {record.seed}: a copy or a misplaced file (left out)"
            )
    records = []
    for method, runs in by_method(sorted(found, key=lambda r: (r.method, r.seed))).items():
        settings = [json.dumps([r.steps, without_seed(r)], sort_keys=True) for r in runs]
        usual = Counter(settings).most_common(1)[0][0]
        for record, given in zip(runs, settings, strict=True):
            if given == usual:
                records.append(record)
            else:
                problems.append(
                    f"{method}, seed {record.seed}: config: expected that of the method's other "
                    f"runs, given another with {record.steps:,} steps (left out)"
                )
    present = {(record.method, record.seed) for record in found}
    wanted = itertools.product(by_method(found), {record.seed for record in records})
    problems += [f"{m}, seed {seed}: no record" for m, seed in sorted({*wanted} - present)]
    budgets = {record.method: record.steps for record in records}
    if len(set(budgets.values())) > 1:
        given = ", ".join(f"{method} {steps:,}" for method, steps in budgets.items())
        problems.append(f"steps: expected one budget for all methods, given {given}")
    return records, problems


def by_method(records: Sequence[Record]) -> dict[str, list[Record]]:
    """Return the records of each method, in the order in which methods first appear."""
    grouped: dict[str, list[Record]] = {}
    for record in records:
        grouped.setdefault(record.method, []).append(record)
    return grouped


def without_seed(record: Record) -> dict[str, Any]:
    """Return what a run's configuration shares with those of other seeds."""
    return {name: value for name, value in record.config.items() if name != "seed"}


def differences(
    one: Mapping[str, Any], other: Mapping[str, Any]
) -> dict[str, tuple[str | None, str | None]]:
    """Return the settings in which two configurations differ, by dotted name, in both as JSON.

    None stands for a setting that is absent.
    """
    first, second = dict(_flat(one)), dict(_flat(other))
    names = sorted({*first, *second})
    pairs = {name: (first.get(name), second.get(name)) for name in names}
    return {name: pair for name, pair in pairs.items() if pair[0] != pair[1]}


def _flat(content: Any, prefix: str = "") -> Iterator[tuple[str, str]]:
    if not isinstance(content, Mapping) or not content:
        yield prefix, json.dumps(content)
        return
    for name, value in content.items():
        yield from _flat(value, f"{prefix}.{name}" if prefix else name)


def _in_words(error: Any) -> str:
    """Return one of pydantic's errors as a sentence that names the field."""
    message = error["msg"].removeprefix("Value error, ")
    field = ".".join(map(str, error["loc"]))
    if error["type"] not in ("value_error", "missing", "json_invalid"):
        shown = repr(error["input"])
        message += f", given {shown if len(shown) <= 80 else shown[:77] + '...'}"
    return f"{field}: {message}" if field else message
