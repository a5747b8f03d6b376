"""Export a policy of every family of sets, test each in onnxruntime, and keep the result.

    python -m experiments.exported [--states 100000] [--families NAME ...] [--keep-times]

Families that are left out keep their rows of the time before. On a machine that others load,
`--keep-times` keeps the times of all rows, too.

The constraint of each policy is one random set of its family in each state, shown as the
observation. Every certified action has to lie in its set and in the action bounds with zero
tolerance, and every other one in the bounds: the command fails otherwise.
"""

from __future__ import annotations

import argparse
import json
import platform
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import torch
from gymnasium import spaces
from tensordict import TensorDictBase
from torch import Tensor

from cnfp_torchrl import constrain_env, make_constrained_actor
from cnfp_torchrl.deploy import DeployedPolicy, export_policy, open_exported, self_test
from cnfp_torchrl.deploy.self_test import latencies
from cnfp_torchrl.envs import GeometryTransform
from cnfp_torchrl.geometry import ConstraintSet
from cnfp_torchrl.installed_versions import installed_versions
from cnfp_torchrl.text_table import markdown_table
from cnfp_torchrl.training.networks import gaussian_network
from cnfp_torchrl.whole_file import whole_file, write_json
from cnfp_torchrl.wrappers.observed_env import ObservedEnv
from experiments.random_sets import FAMILIES

RESULT = Path(__file__).parent / "results" / "exported.md"
ROWS = RESULT.with_suffix(".json")

LARGEST = 6
"""The most action components that are tested of a family."""

DIMENSIONS = {name: max(d for d in dims if d <= LARGEST) for name, (_, dims) in FAMILIES.items()}
"""The families, each with the number of action components."""

FAR = 1e8


class Shown(GeometryTransform):
    """The sets whose fields are the observation."""

    def __init__(self, family: type[ConstraintSet]) -> None:
        super().__init__("shown", in_keys=list(family.event_dims))
        self.family = family

    def constraint_set(self, tensordict: TensorDictBase) -> ConstraintSet:
        fields = {name: tensordict[name] for name in self.family.event_dims}
        # Observations are finite; what is not, in a set, is shown as a number beyond all others.
        fields = {
            name: torch.where(value.abs() >= FAR, value.sign() * torch.inf, value)
            for name, value in fields.items()
        }
        return self.family(**fields, validate_args=False)


def policy_of(name: str, count: int, **options: Any) -> tuple[DeployedPolicy, tuple[Tensor, ...]]:
    """Return a policy whose constraint is a set of a family, and inputs of random sets of it.

    Args:
        name: The family's name in `DIMENSIONS`.
        count: The number of states.
        options: Further arguments of `DeployedPolicy`.
    """
    torch.manual_seed(0)
    dim = DIMENSIONS[name]
    sets, _ = FAMILIES[name][0]((count,), dim)
    sets = sets.with_fields(
        lambda field, dims: field.float().expand(count, *field.shape[field.ndim - dims :])
    )
    fields = {key: value.clamp(-FAR, FAR) for key, value in sets.fields().items()}
    large = {key: spaces.Box(-1e9, 1e9, value.shape[1:]) for key, value in fields.items()}
    space = spaces.Dict({**large, "observation": spaces.Box(-9, 9, (3,))})
    observed = ObservedEnv(space, spaces.Box(-4, 4, (dim,)))
    # The zeros of a spec need not be a set; the first one is.
    observed.show(
        {key: value[0].numpy() for key, value in fields.items()} | {"observation": [0.0] * 3}
    )
    env = constrain_env(observed, Shown(type(sets)))
    actor = make_constrained_actor(gaussian_network(3, dim, hidden=[16]), env)
    policy = DeployedPolicy(actor, env, **options)
    inputs = {**fields, "observation": 3 * torch.randn(count, 3)}
    return policy, tuple(inputs[key] for key in policy.input_keys)


def row_of(name: str, states: int) -> list[str]:
    """Export a family's policy, and return its name and what was measured, as in `HEADER`."""
    policy, inputs = policy_of(name, states)
    with tempfile.TemporaryDirectory() as folder:
        export_policy(policy, folder)
        run = open_exported(folder)
    found = self_test(policy, run, inputs)
    first = [value[:1] for value in inputs]
    taken = latencies({"eager": policy, "onnx": run}, first, rounds=100, clock=time.thread_time)
    return [
        name,
        str(DIMENSIONS[name]),
        f"{found['certified'] / found['states']:.2%}",
        str(found["violations"]),
        str(found["fallback_out_of_bounds"]),
        str(found["certified_otherwise_in_eager"]),
        f"{found['largest_difference']:.1e}",
        f"{taken['eager']:.2f}",
        f"{taken['onnx']:.2f}",
    ]


HEADER = [
    "family",
    "d",
    "certified",
    "violations",
    "fallbacks out of bounds",
    "otherwise certified in eager mode",
    "largest difference from eager mode",
    "eager, ms",
    "onnxruntime, ms",
]


def main() -> None:
    """Do it for all families, and write `RESULT`."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--states", type=int, default=100_000)
    parser.add_argument("--families", nargs="+", choices=DIMENSIONS, default=list(DIMENSIONS))
    parser.add_argument("--keep-times", action="store_true")
    options = parser.parse_args()
    torch.set_num_threads(1)
    rows = json.loads(ROWS.read_text()) if ROWS.is_file() else {}
    for name in options.families:
        before, rows[name] = rows.get(name), row_of(name, options.states)
        if options.keep_times and before is not None:
            rows[name][-2:] = before[-2:]
        sys.stdout.write(f"{' | '.join(rows[name])}\n")
        sys.stdout.flush()
        write_json(ROWS, rows)
    packages = installed_versions(["torch", "torchrl", "onnx", "onnxruntime"])
    known = ", ".join(f"{package} {version}" for package, version in packages.items())
    kept = " Times are those of a run before." if options.keep_times else ""
    flag = " --keep-times" if options.keep_times else ""
    text = (
        "# Exported policies of every family\n\n"
        f"`python -m experiments.exported --states {options.states}{flag}`\n\n"
        f"python {platform.python_version()}, {known}\n\n"
        f"{options.states:,} states of each family, every one with a random set of its own, in "
        "onnxruntime. Violations are certified actions outside of their set or the action bounds, "
        "with zero tolerance. Times are medians of 100 calls with one state, eager mode and "
        "onnxruntime by turns, on one thread of the processor, in its own time."
        f"{kept}\n\n"
        f"{markdown_table([HEADER, *(rows[name] for name in DIMENSIONS if name in rows)])}\n"
    )
    with whole_file(RESULT) as file:
        file.write(text.encode())
    sys.stdout.write(text)
    if wrong := [row[0] for row in rows.values() if row[3] != "0" or row[4] != "0"]:
        sys.exit(f"actions of {wrong} lie outside of what is allowed")


if __name__ == "__main__":
    main()
