"""What is trained: tasks, methods and seeds, and the settings that all methods share."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from omegaconf import DictConfig

from cnfp_torchrl.configuration import compose_config

FOLDER = Path(__file__).parent
DATA = FOLDER / "data"
RANDOM_ACTIONS = "random_actions"
"""The folder in `DATA` of what random actions did, a file for each task."""
SAFE_CONTROL = "safe_control"
"""The folder in `DATA` of controllers trained through layers, a file for each run."""

ACTION_SIZES = {
    "half_cheetah_power": 6,
    "half_cheetah_rate": 6,
    "hopper_mixed": 3,
    "hopper_drawn_power": 3,
    "walker2d_drawn_power": 6,
    "hopper_rate": 3,
    "ant_rate": 8,
}
"""The number d of action components of each task, a file of ``conf/env``."""

TRAINED = ("half_cheetah_power", "half_cheetah_rate", "hopper_mixed")
"""The tasks with kept records; the others take the same command."""

FLOWS = {
    "hard": ("flow=exact",),
    "soft": ("flow=soft",),
    "sharp": ("flow=soft", "+flow.sharpness=4"),
    "projection": ("flow=projection",),
    "unconstrained": ("flow=unconstrained",),
}
"""Our methods, by the overrides that choose the flow of each."""

OURS = ("hard", "soft", "sharp")
"""Those of them that are bijections; the others are baselines."""

PEER = "sb3_projection"
"""Stable-Baselines3's SAC, whose actions the environment projects."""

METHODS = (*FLOWS, PEER)
ONE_SEED = ("unconstrained",)
"""Methods that are no candidates: one seed says what constraints cost."""

ROUNDS = 8
"""Rounds of Dykstra's algorithm: on hopper_mixed they leave a mean distance of 0.001."""

SETTINGS = (
    "loss.gamma=0.99",
    "network.hidden=[256,256]",
    "optim.lr=3e-4",
    "replay_buffer.batch_size=256",
    "training.warmup_frames=1000",
    "training.update_ratio=0.5",
    "collector.total_frames=30000",
    "evaluation.episodes=8",
    "logger=none",
    "figures=none",
)


@dataclass(frozen=True)
class Job:
    """One training run.

    Args:
        task: A key of `ACTION_SIZES`.
        method: One of `METHODS`.
        seed: The seed of everything random.
    """

    task: str
    method: str
    seed: int

    def __post_init__(self) -> None:
        for name, given, known in (
            ("task", self.task, ACTION_SIZES),
            ("method", self.method, METHODS),
        ):
            if given not in known:
                raise ValueError(f"{name}: expected one of {list(known)}, given {given!r}")

    def path(self, data: Path) -> Path:
        """Return the file of the run's record in a folder of records."""
        return data / self.task / self.method / f"seed_{self.seed}.json"

    def config(self, overrides: tuple[str, ...] = ()) -> DictConfig:
        """Return the training configuration; the peer's has the environment of a projection."""
        flow = FLOWS.get(self.method, FLOWS["projection"])
        own = [
            f"env={self.task}",
            *flow,
            f"seed={self.seed}",
            f"loss.target_entropy={-ACTION_SIZES[self.task]}",
        ]
        if flow == FLOWS["projection"]:
            # Of Dykstra's algorithm, for hopper_mixed alone; the other sets have closed forms.
            own.append(f"+flow.rounds={ROUNDS}")
        return compose_config(*own, *SETTINGS, *overrides)


def all_jobs(tasks: tuple[str, ...], methods: tuple[str, ...], seeds: tuple[int, ...]) -> list[Job]:
    """Return the runs, the longest first: those that project by an algorithm."""
    jobs = [
        Job(task, method, seed)
        for seed in seeds
        for method in methods
        for task in tasks
        if seed == seeds[0] or method not in ONE_SEED
    ]
    return sorted(jobs, key=lambda job: not ("mixed" in job.task and "projection" in job.method))
