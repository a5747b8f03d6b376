"""One small file for each run: what was run, on what, and what came out of it.

A record stands at ``FOLDER/METHOD/seed_S.json``. Reading is strict: whatever is missing, cut,
foreign, not finite or inconsistent is an error that names the file and the field.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cnfp_torchrl.whole_file import whole_file
from experiments.paper.fields import Fields, RecordError

FORMAT, VERSION = "cnfp_torchrl paper record", 1
MODES = ("stochastic", "deterministic")
"""How a trained policy is evaluated: actions drawn, or the distribution's mode."""

RETURN, SECONDS, PROCESSOR, VIOLATIONS = (
    "train/return",
    "train/seconds",
    "train/processor_seconds",
    "violations/",
)


@dataclass(frozen=True)
class Series:
    """A scalar over training.

    Args:
        steps: environment steps since the start, strictly rising.
        values: one for each of the steps.
    """

    steps: tuple[int, ...]
    values: tuple[float, ...]


@dataclass(frozen=True)
class Outcome:
    """What a policy did in whole episodes.

    Args:
        return_mean: mean undiscounted return of an episode.
        return_standard_error: of that mean.
        score: the mean return on the task's scale.
        violations: violating steps by constraint, all episodes together.
        episodes: how many.
        steps: environment steps, all episodes together.
    """

    return_mean: float
    return_standard_error: float
    score: float
    violations: dict[str, int]
    episodes: int
    steps: int


@dataclass(frozen=True)
class Record:
    """One finished run.

    Args:
        method: name of its experiment, a file of ``conf/experiment``.
        seed: of everything random.
        overrides: what was given to the trainer beside experiment and seed.
        config: the training configuration, every interpolation resolved.
        versions: of Python and of the packages that decide the numbers.
        commit: of the repository, ``None`` where it is not known.
        steps: environment steps of training.
        seconds: wall time of training and evaluation; runs beside it slow it down.
        curves: logged scalars by name: ``train/return``, cumulative ``violations/NAME``,
            ``train/seconds``, ``train/processor_seconds``, and whatever else the method logs.
        training_violations: violating steps by constraint while training.
        evaluation: the trained policy by mode, see `MODES`.
        afterwards: the same policy after a change of the task that it was not trained for, by the
            change's name and by mode; empty where that was not evaluated.
    """

    method: str
    seed: int
    overrides: tuple[str, ...]
    config: dict[str, Any]
    versions: dict[str, str]
    commit: str | None
    steps: int
    seconds: float
    curves: dict[str, Series]
    training_violations: dict[str, int]
    evaluation: dict[str, Outcome]
    afterwards: dict[str, dict[str, Outcome]]

    @property
    def constraints(self) -> tuple[str, ...]:
        """Names of the constraints, in the order of the costs."""
        return tuple(self.training_violations)

    @property
    def violations(self) -> dict[str, int]:
        """Violating steps by constraint, in training and both evaluations."""
        outcomes = self.evaluation.values()
        return {
            name: count + sum(outcome.violations[name] for outcome in outcomes)
            for name, count in self.training_violations.items()
        }

    def path(self, folder: Path) -> Path:
        """Return where the record stands in a folder of records."""
        return folder / self.method / f"seed_{self.seed}.json"

    def save(self, folder: Path) -> Path:
        """Write the record, complete or not at all, and return its path.

        A record that stands there already may only gain results under ``afterwards``.

        Raises:
            FileExistsError: when another record, or something else, stands there.
            RecordError: when the record could not be read back.
        """
        path = self.path(folder)
        if path.exists() and not self._extends(path):
            raise FileExistsError(
                f"{path}: expected no file or the record of this very run, but it holds another; "
                "move it away, or choose another folder for the records"
            )
        path.parent.mkdir(parents=True, exist_ok=True)
        document = {"format": FORMAT, "version": VERSION, **dataclasses.asdict(self)}
        with whole_file(path) as file:
            file.write(f"{json.dumps(document)}\n".encode())
            file.flush()
            load_record(Path(file.name))
        return path

    def _extends(self, path: Path) -> bool:
        try:
            other = load_record(path)
        except RecordError:
            return False
        kept = all(self.afterwards.get(name) == each for name, each in other.afterwards.items())
        return kept and dataclasses.replace(other, afterwards=self.afterwards) == self


def load_record(path: Path) -> Record:
    """Read a record.

    Raises:
        RecordError: naming the file, the field, what was expected and what was given.
    """
    fields = Fields.read(path)
    for name, expected in (("format", FORMAT), ("version", VERSION)):
        if (given := fields.take(name)) != expected:
            raise fields.error(name, f"expected {expected!r}, given {given!r}")
    commit = fields.take("commit")
    if not (commit is None or isinstance(commit, str)):
        raise fields.error("commit", f"expected a text or null, given {commit!r}")
    record = Record(
        method=fields.text("method"),
        seed=fields.whole("seed"),
        overrides=tuple(fields.texts("overrides")),
        config=dict(fields.mapping("config")),
        versions={name: str(each) for name, each in fields.mapping("versions").items()},
        commit=commit,
        steps=fields.whole("steps"),
        seconds=fields.number("seconds"),
        curves={name: _series(each) for name, each in fields.parts("curves").items()},
        training_violations=fields.counts("training_violations"),
        evaluation=_outcomes(fields.part("evaluation")),
        afterwards={name: _outcomes(each) for name, each in fields.parts("afterwards").items()},
    )
    fields.nothing_left()
    _check(record, fields)
    return record


def _series(fields: Fields) -> Series:
    series = Series(tuple(fields.wholes("steps")), tuple(fields.numbers("values")))
    fields.nothing_left()
    if len(series.steps) != len(series.values) or not series.steps:
        raise fields.error(
            "values",
            f"expected as many as steps, at least one, given {len(series.values)} values and "
            f"{len(series.steps)} steps",
        )
    if any(a >= b for a, b in itertools.pairwise(series.steps)):
        raise fields.error("steps", "expected rising numbers, given some that do not rise")
    return series


def _outcomes(fields: Fields) -> dict[str, Outcome]:
    outcomes = {mode: _outcome(fields.part(mode)) for mode in MODES}
    fields.nothing_left()
    return outcomes


def _outcome(fields: Fields) -> Outcome:
    outcome = Outcome(
        return_mean=fields.number("return_mean"),
        return_standard_error=fields.number("return_standard_error"),
        score=fields.number("score"),
        violations=fields.counts("violations"),
        episodes=fields.whole("episodes"),
        steps=fields.whole("steps"),
    )
    fields.nothing_left()
    return outcome


def _check(record: Record, fields: Fields) -> None:
    """Refuse what contradicts itself."""
    if record.config.get("seed") != record.seed:
        given = record.config.get("seed")
        raise fields.error("config.seed", f"expected {record.seed} as in 'seed', given {given!r}")
    needed = [RETURN, SECONDS, PROCESSOR, *(VIOLATIONS + name for name in record.constraints)]
    if missing := [name for name in needed if name not in record.curves]:
        raise fields.error("curves", f"expected {needed}, but {missing} are missing")
    for name, series in record.curves.items():
        if series.steps[-1] > record.steps:
            raise fields.error(
                f"curves.{name}.steps", f"expected at most {record.steps}, given {series.steps[-1]}"
            )
    for name, count in record.training_violations.items():
        values = record.curves[VIOLATIONS + name].values
        if any(a > b for a, b in itertools.pairwise(values)) or values[-1] != count:
            raise fields.error(
                f"curves.{VIOLATIONS}{name}.values",
                f"expected counts that never fall and end at {count}, given {values[-1]} last",
            )
    outcomes: Mapping[str, dict[str, Outcome]] = {
        "evaluation": record.evaluation,
        **{f"afterwards.{name}": each for name, each in record.afterwards.items()},
    }
    for name, modes in outcomes.items():
        for mode, outcome in modes.items():
            if tuple(outcome.violations) != record.constraints:
                raise fields.error(
                    f"{name}.{mode}.violations",
                    f"expected the constraints {list(record.constraints)}, given "
                    f"{list(outcome.violations)}",
                )
