"""Explain one step of a run's evaluation in the terminal: the command ``cnfp-explain``."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from cnfp_torchrl.commands.extras import needs_extra

with needs_extra("train"):
    import torch
    from tensordict import TensorDictBase

    from cnfp_torchrl.envs import counted_constraints, find_task_view
    from cnfp_torchrl.keys import COST_KEY, REWARD_KEY
    from cnfp_torchrl.modules import flow_head
    from cnfp_torchrl.training.agent import build_environment, load_actor
    from cnfp_torchrl.training.episodes import record_episode
    from cnfp_torchrl.training.run_folder import RunFolder
    from cnfp_torchrl.training.settings import EvaluationSettings
    from cnfp_torchrl.visual.explanation import explain
    from cnfp_torchrl.visual.replay import replay_step

_SAMPLES = 1000


def explain_run(
    folder: RunFolder,
    *,
    step: int,
    episode: int = 0,
    episodes: int | None = None,
    seed: int | None = None,
    deterministic: bool = False,
    trusted: Sequence[str] = (),
) -> str:
    """Return an explanation of what the trained policy did in one step of an evaluation episode.

    The episode is that of ``cnfp-evaluate`` with the same number of episodes and the same seed.

    Args:
        folder: The folder of a finished run.
        step: The step's number in the episode, from 0.
        episode: The episode's number in the evaluation, from 0.
        episodes: The number of episodes of the evaluation; None takes the run's.
        seed: The seed of the evaluation; None takes the run's.
        deterministic: Whether the policy acts deterministically.
        trusted: The packages that the run's configuration may name, see `RunFolder.load_config`.

    Raises:
        ValueError: for a step or an episode that does not exist, and for a flow without stages.
    """
    config = folder.load_config(trusted)
    settings = EvaluationSettings(
        config.evaluation.episodes if episodes is None else episodes,
        config.evaluation.seed if seed is None else seed,
    )
    if not 0 <= episode < settings.episodes:
        raise ValueError(
            f"--episode: expected a number from 0 to {settings.episodes - 1}, given {episode}"
        )
    if step < 0:
        raise ValueError(f"--step: expected a number >= 0, given {step}")
    env = build_environment(config, batch_size=[1], with_anchor=True)
    actor = load_actor(folder, config, env)
    if not flow_head(actor).flow.has_density:
        raise ValueError(
            f"{folder.path}: expected a flow with stages, such as flow=exact, given "
            f"{type(flow_head(actor).flow).__name__}, which has none to explain"
        )
    steps = record_episode(env, actor, settings, episode, deterministic=deterministic)
    if step >= len(steps):
        raise ValueError(
            f"--step: expected a number from 0 to {len(steps) - 1}, the last of episode {episode}, "
            f"given {step}"
        )
    transition = steps[step]
    dim = transition.get(flow_head(actor).action_key).shape[-1]
    noise = torch.randn(_SAMPLES, dim, generator=torch.Generator().manual_seed(0))
    snapshot = replay_step(actor, transition, noise)
    explanation = explain(snapshot, find_task_view(env))
    policy = "deterministic" if deterministic else "stochastic"
    head = f"Step {step} of {len(steps)}, episode {episode}, seed {settings.seed}, {policy} policy"
    return f"{head}\n\n{explanation.text()}\n{_outcome(transition, counted_constraints(env))}\n"


def main(arguments: Sequence[str] | None = None) -> None:
    """Print `explain_run` for the arguments of the command line."""
    parser = argparse.ArgumentParser(
        prog="cnfp-explain",
        description="Explain what a trained policy did in one step of an "
        "evaluation episode: the action before and after each constraint, and why.",
    )
    parser.add_argument("run", help="folder of a finished run")
    parser.add_argument("--step", type=int, required=True, help="of the episode, from 0")
    parser.add_argument("--episode", type=int, default=0, help="of the evaluation, from 0")
    parser.add_argument("--episodes", type=int, help="of the whole evaluation (the run's)")
    parser.add_argument("--seed", type=int, help="of the evaluation (the run's)")
    parser.add_argument(
        "--deterministic", action="store_true", help="the deterministic policy, not the stochastic"
    )
    parser.add_argument(
        "--trusted",
        action="append",
        default=[],
        metavar="PACKAGE",
        help="that the run's configuration may name beside this one, such as my_package.",
    )
    given = parser.parse_args(arguments)
    options = vars(given)
    try:
        explanation = explain_run(RunFolder.open(options.pop("run")), **options)
    except (ValueError, FileNotFoundError, PermissionError) as error:
        parser.exit(2, f"{parser.prog}: error: {error}\n")
    sys.stdout.write(explanation)


def _outcome(transition: TensorDictBase, names: Sequence[str]) -> str:
    outcome = transition.get("next")
    reward = f"Reward {float(outcome.get(REWARD_KEY).sum()):.3f}"
    if not names:
        return f"{reward}."
    costs = outcome.get(COST_KEY).tolist()
    broken = [name for name, cost in zip(names, costs, strict=True) if cost]
    return f"{reward}; the environment counted {' and '.join(broken) or 'no'} violations."


if __name__ == "__main__":
    main()
