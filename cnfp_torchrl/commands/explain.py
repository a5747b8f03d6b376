"""Explain an episode of a trained policy in the terminal: the command ``cnfp-explain``."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from textwrap import fill

from cnfp_torchrl.commands.extras import needs_extra
from cnfp_torchrl.commands.run_options import FINISHED_RUN

with needs_extra("train"):
    import torch
    from hydra.utils import instantiate
    from tensordict import TensorDictBase

    from cnfp_torchrl.commands.refusals import errors_in_a_sentence
    from cnfp_torchrl.keys import COST_KEY, OBSERVATION_KEY, REWARD_KEY
    from cnfp_torchrl.modules import flow_head
    from cnfp_torchrl.training.agent import build_environment, load_actor
    from cnfp_torchrl.training.episodes import record_episode
    from cnfp_torchrl.training.run_folder import CHECKPOINT, RunFolder
    from cnfp_torchrl.training.settings import EvaluationSettings
    from cnfp_torchrl.visual.explanation import explain
    from cnfp_torchrl.visual.replay import replay_step
    from cnfp_torchrl.visual.setting import Setting
    from cnfp_torchrl.visual.step_list import record_table, step_records, steps_worth_a_look

_SAMPLES = 1000


def explain_run(
    folder: RunFolder,
    *,
    step: int | None = None,
    episode: int = 0,
    seed: int | None = None,
    deterministic: bool = False,
    every_step: bool = False,
    trusted: Sequence[str] = (),
) -> str:
    """Return an explanation of what the trained policy did in an episode.

    Of one step, everything; without a step, a table of those worth a look, or of all.

    Args:
        folder: The folder of a finished run.
        step: The step's number in the episode, from 0; None for a table.
        episode: The episode's number, from 0.
        seed: The seed of the first episode; None takes that of the run's evaluation.
        deterministic: Whether the policy acts deterministically.
        every_step: Whether the table has all steps.
        trusted: The packages that the run's configuration may name, see `RunFolder.load_config`.

    Raises:
        ValueError: for a step or an episode that does not exist, and for a flow without stages.
    """
    for name, number in (("--episode", episode), ("--step", step)):
        if number is not None and number < 0:
            raise ValueError(f"{name}: expected a number >= 0, given {number}")
    config = folder.load_config(trusted)
    settings: EvaluationSettings = instantiate(config.evaluation)
    if seed is not None:
        settings = replace(settings, seed=seed)
    env = build_environment(config, batch_size=[1], with_anchor=True)
    actor = load_actor(folder, config, env)
    head = flow_head(actor)
    if not head.flow.has_density:
        raise ValueError(
            f"{folder.path}: expected a flow with stages, such as flow=exact, given "
            f"{type(head.flow).__name__}, which has none to explain"
        )
    steps = record_episode(env, actor, settings, episode, deterministic=deterministic)
    setting = Setting.of(head, env)
    policy = "deterministic" if deterministic else "stochastic"
    of = "" if folder.checkpoint == CHECKPOINT else f" of {folder.checkpoint}"
    title = f"episode {episode}, seed {settings.seed + episode}, {policy} policy{of}"
    if step is None:
        records = step_records(actor, steps, setting.costs)
        if every_step:
            return f"{len(steps)} steps of {title}\n\n{record_table(records, (), setting.unit)}\n"
        found = steps_worth_a_look(records) or [(records[0], "no constraint did anything")]
        chosen, reasons = [record for record, _ in found], [reason for _, reason in found]
        table = record_table(chosen, reasons, setting.unit)
        advice = "See one of them with --step N, all with --all."
        return f"Steps worth a look, of {len(steps)}; {title}\n\n{table}\n\n{advice}\n"
    if step >= len(steps):
        raise ValueError(
            f"--step: expected a number from 0 to {len(steps) - 1}, the last of episode {episode}, "
            f"given {step}"
        )
    noise = torch.randn(_SAMPLES, setting.dim, generator=torch.Generator().manual_seed(0))
    snapshot = replay_step(actor, steps[step], noise)
    explanation = explain(snapshot, setting.view, setting.components)
    parts = [f"Step {step} of {len(steps)}, {title}", explanation.text().rstrip()]
    if setting.observation:
        parts.append(_observation(steps[step], setting))
    return "\n\n".join([*parts, _outcome(steps[step], setting.costs)]) + "\n"


def main(arguments: Sequence[str] | None = None) -> None:
    """Print `explain_run` for the arguments of the command line."""
    parser = argparse.ArgumentParser(
        prog="cnfp-explain",
        description="Explain what a trained policy did in an episode: the steps worth a look, or "
        "one step, the action before and after each constraint, and why.",
        parents=[FINISHED_RUN],
    )
    which = parser.add_mutually_exclusive_group()
    which.add_argument("--step", type=int, help="of the episode, from 0 (those worth a look)")
    which.add_argument(
        "--all", action="store_true", dest="every_step", help="a table of all steps of the episode"
    )
    parser.add_argument("--episode", type=int, default=0, help="its number, from 0")
    parser.add_argument("--seed", type=int, help="of episode 0 (that of the run's evaluation)")
    parser.add_argument(
        "--deterministic", action="store_true", help="the deterministic policy, not the stochastic"
    )
    given = parser.parse_args(arguments)
    options = vars(given)
    with errors_in_a_sentence(parser.prog, status=2):
        folder = RunFolder.open(options.pop("run"), options.pop("checkpoint"))
        explanation = explain_run(folder, **options)
    sys.stdout.write(explanation)


def _observation(transition: TensorDictBase, setting: Setting) -> str:
    values = transition.get(OBSERVATION_KEY).tolist()
    named = zip(setting.observation, values, strict=True)
    parts = [f"{part.name} {value:.3f} {part.unit}".rstrip() for part, value in named]
    return fill(f"Observation: {', '.join(parts)}.", 100)


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
