"""Single episodes, step by step, to be looked at."""

from __future__ import annotations

from itertools import islice

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import SafeProbabilisticTensorDictSequential

from cnfp_torchrl.envs import Camera
from cnfp_torchrl.keys import PIXELS_KEY
from cnfp_torchrl.modules import guarded
from cnfp_torchrl.training.evaluation import transitions
from cnfp_torchrl.training.settings import EvaluationSettings


@torch.no_grad()
def record_episode(
    env: EnvBase,
    actor: SafeProbabilisticTensorDictSequential,
    settings: EvaluationSettings,
    number: int = 0,
    *,
    deterministic: bool = False,
    render_every: int = 0,
) -> list[TensorDictBase]:
    """Return the transitions of one episode, each of batch size ``()``.

    An episode has a seed of its own, so that none depends on how many others are run.

    Args:
        env: The environment with anchor and active flags; a batch of one takes the least time, of
            more the first agent is recorded.
        actor: The actor.
        settings: The seed of the first episode, and the length at which episodes are cut off.
        number: The number of the episode, from 0.
        deterministic: Whether to take `deterministic_sample` instead of drawing.
        render_every: The interval n in states: of every n-th, a picture is kept at ``pixels``, as
            far as the environment renders itself; 0: of none.
    """
    env.set_seed(settings.seed + number)
    torch.manual_seed(settings.seed + number)
    mode = ExplorationType.DETERMINISTIC if deterministic else ExplorationType.RANDOM
    camera, policy = Camera(env), guarded(actor, env)
    episode: list[TensorDictBase] = []

    def act(state: TensorDictBase) -> TensorDictBase:
        is_due = render_every and len(episode) % render_every == 0
        pictures.append(camera.picture() if is_due else None)
        return policy(state)

    pictures: list[Tensor | None] = []
    with set_exploration_type(mode):
        for transition in islice(transitions(env, act), settings.max_steps):
            episode.append(transition.reshape(-1)[0].clone())
            picture = pictures[len(episode) - 1]
            if picture is not None and PIXELS_KEY not in episode[-1].keys():  # noqa: SIM118
                episode[-1].set(PIXELS_KEY, picture)
            if bool(episode[-1]["next", "done"].any()):
                break
    return episode
