"""A collector's hook and an environment's transform, which stream any TorchRL pipeline."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NoReturn

import numpy as np
from tensordict import TensorDictBase
from torchrl.envs import Transform

from cnfp_torchrl.visual.rerun.stream import FlowStream


class StreamHook:
    """Stream what a collector collected, for one of its agents.

    Give it to the collector and go on as before::

        collector = Collector(env, actor, ..., post_collect_hook=StreamHook(stream))

    It runs in the process of whoever iterates over the collector. ``env_step`` counts the frames
    of all agents, as collectors do. Batches are not changed.

    Args:
        stream: The stream of the collector's policy.
        agent: The index of the agent in the flattened batch of environments.

    Raises:
        ValueError: when the collected batch has no such agent or no time dimension.
    """

    def __init__(self, stream: FlowStream, agent: int = 0) -> None:
        if agent < 0:
            raise ValueError(f"agent: expected an index >= 0, given {agent}")
        self._stream, self._agent = stream, agent
        self.frames = 0
        """Streamed or counted so far, of all agents."""

    def __call__(self, batch: TensorDictBase) -> None:
        """Stream a batch ``(*environments, time)``."""
        if batch.ndim == 0:
            raise ValueError("batch: expected (*environments, time), given no time dimension")
        agents = batch.numel() // batch.shape[-1]
        if self._agent >= agents:
            raise ValueError(
                f"agent: expected an index below {agents}, the number of environments in a batch "
                f"of shape {tuple(batch.shape)}, given {self._agent}"
            )
        index = _agent_index(self._agent, batch.shape[:-1])
        for time in range(batch.shape[-1]):
            self._stream.log_step(self.frames, _entries_for(self._stream, batch)[(*index, time)])
            self.frames += agents

    def __reduce__(self) -> NoReturn:
        raise _refusal_to_be_sent("StreamHook")


class StreamTransform(Transform):
    """Stream each step of an environment, whoever steps it; append it after all other transforms.

    ``env.append_transform(StreamTransform(stream))``

    The environment must be stepped in the process of the stream: not in a worker's. Of a batched
    environment one agent is streamed; ``env_step`` counts its steps.

    Args:
        stream: The stream of the policy that steps the environment.
        agent: The index of the agent in the flattened batch.
    """

    def __init__(self, stream: FlowStream, agent: int = 0) -> None:
        super().__init__()
        if agent < 0:
            raise ValueError(f"agent: expected an index >= 0, given {agent}")
        self._stream, self._agent = stream, agent
        self._steps = 0

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        transition = tensordict.exclude("next").set("next", next_tensordict)
        index = _agent_index(self._agent, transition.shape)
        self._stream.log_step(self._steps, _entries_for(self._stream, transition)[index])
        self._steps += 1
        return next_tensordict

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return tensordict_reset

    def __reduce__(self) -> NoReturn:
        raise _refusal_to_be_sent("StreamTransform")


def _entries_for(stream: FlowStream, batch: TensorDictBase) -> TensorDictBase:
    """Return what the stream will read of its next step.

    To index every entry of a batch takes several times as long as to count a step.
    """
    keys = None if stream.is_due else stream.counted_keys
    return batch if keys is None else batch.select(*keys, strict=False)


def _agent_index(agent: int, shape: Sequence[int]) -> tuple[int, ...]:
    """Return the index of an agent in environments of a shape, by that in the flattened ones."""
    return tuple(int(i) for i in np.unravel_index(agent, tuple(shape)))


def _refusal_to_be_sent(name: str) -> TypeError:
    return TypeError(
        f"{name}: expected to stay in the process that opened the recording, but was to be sent to "
        "another one, such as a collector's worker; give it to a collector in the main process"
    )
