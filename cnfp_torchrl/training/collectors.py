"""Collectors in several processes: environment, geometry, anchor and policy run in each of them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from threading import Thread
from typing import Any

import torch
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.collectors import BaseCollector, MultiAsyncCollector, MultiSyncCollector
from torchrl.envs import EnvBase, TransformedEnv

from cnfp_torchrl.modules import WarmUpPolicy
from cnfp_torchrl.training.agent import training_environment
from cnfp_torchrl.training.interruption import starting_workers

MakeEnv = Callable[[], EnvBase]


def make_collector(
    config: DictConfig, env: TransformedEnv, policy: TensorDictModuleBase
) -> BaseCollector | WorkerCollector:
    """Return the collector of a configuration.

    Args:
        config: The configuration of the run.
        env: The environment of training, for a collector in this process.
        policy: The policy of training.
    """
    make = instantiate(config.collector, _partial_=True)
    if not (isinstance(make.func, type) and issubclass(make.func, WorkerCollector)):
        return make(env, policy)
    plain = OmegaConf.to_container(config, resolve=True)
    return make(partial(_worker_environment, plain), policy)


def _worker_environment(config: Any, worker: int, frames: int) -> TransformedEnv:
    """Return a worker's environment, with random numbers of its own.

    Args:
        config: The configuration of the run, as plain data.
        worker: The number of the worker.
        frames: The number of frames so far, after which a resumed run draws other numbers than at
            its beginning.
    """
    composed = OmegaConf.create(config)
    seed = composed.seed + worker + frames
    torch.set_num_threads(composed.threads)
    torch.manual_seed(seed + 1)
    env = training_environment(composed)
    env.set_seed(seed)
    return env


@contextmanager
def shutting_down(collector: BaseCollector | WorkerCollector) -> Iterator[None]:
    """Shut a collector down at the end, whatever happens."""
    try:
        yield
    finally:
        collector.shutdown()


class WorkerPolicy(TensorDictModuleBase):
    """A warm-up in workers: acts at random as long as it is told to.

    It does not count, as `WarmUpPolicy` does: no worker knows how many actions the others have
    taken. Whether to act at random is a buffer, which travels with the weights.

    Args:
        policy: The policy of training.
    """

    acts_at_random: Tensor

    def __init__(self, policy: WarmUpPolicy) -> None:
        super().__init__()
        # Compiled programs do not travel to other processes.
        self.actor = getattr(policy.actor, "_orig_mod", policy.actor)
        self.random = policy.random
        self.register_buffer("acts_at_random", torch.tensor(policy.frames_left > 0))
        self.in_keys, self.out_keys = policy.in_keys, policy.out_keys

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write a random action in the warm-up, then the actor's."""
        # The actor runs first, for entries that it alone writes: all steps must have the same.
        self.actor(tensordict)
        return self.random(tensordict) if bool(self.acts_at_random) else tensordict


class WorkerCollector(ABC):
    """Collect in workers, tell them the weights after each batch, and count for all of them.

    Workers start when it is iterated over. A resumed run goes on with the counts, and with new
    episodes.

    Args:
        make_env: What makes the environment of a worker, given its number and the frames so far.
        policy: The policy of training.
        workers: The number of workers.
        frames_per_batch: The number of frames that a worker collects at a time.
        total_frames: The number of frames to collect in all.

    Raises:
        ValueError: for fewer than one worker.
    """

    def __init__(
        self,
        make_env: Callable[[int, int], EnvBase],
        policy: TensorDictModuleBase,
        *,
        workers: int,
        frames_per_batch: int,
        total_frames: int,
    ) -> None:
        if workers < 1:
            raise ValueError(f"collector.workers: expected a number >= 1, given {workers}")
        self._make_env, self._workers = make_env, workers
        self._policy = policy
        self._frames_per_batch, self._total_frames = frames_per_batch, total_frames
        self._frames = 0
        self._running: Any = None

    @abstractmethod
    def _start(
        self, make_envs: Sequence[MakeEnv], policy: TensorDictModuleBase, frames: int
    ) -> Any:
        """Return a running collector of TorchRL's for a number of frames."""

    def __iter__(self) -> Iterator[TensorDictBase]:
        """Yield transitions ``(*environments, time)``."""
        warm_up = self._policy if isinstance(self._policy, WarmUpPolicy) else None
        acting = self._policy if warm_up is None else WorkerPolicy(warm_up)
        make_envs = [partial(self._make_env, i, self._frames) for i in range(self._workers)]
        self._running = self._start(make_envs, acting, self._total_frames - self._frames)
        for batch in self._running:
            self._frames += batch.numel()
            if warm_up is not None:
                warm_up.frames_left = max(warm_up.frames_left - batch.numel(), 0)
            yield batch.flatten(0, batch.ndim - 2) if batch.ndim > 2 else batch
            if warm_up is not None:
                acting.acts_at_random.fill_(warm_up.frames_left > 0)
            self._tell_weights(acting)

    def _tell_weights(self, policy: TensorDictModuleBase) -> None:
        self._running.update_policy_weights_(policy)

    def shutdown(self) -> None:
        """Stop the workers."""
        if self._running is not None:
            self._running.shutdown()
            self._running = None

    def state_dict(self) -> dict[str, Any]:
        """Return the number of frames so far."""
        return {"frames": self._frames}

    def load_state_dict(self, state: dict[str, Any], strict: bool = True) -> None:
        """Go on after a number of frames."""
        self._frames = int(state["frames"])


class WorkerDiedError(RuntimeError):
    """A process of a collector has ended before the run."""


class _Processes(WorkerCollector):
    """Workers that are processes of this machine; when one dies, the run ends.

    TorchRL waits for its answer for ever.
    """

    def __iter__(self) -> Iterator[TensorDictBase]:
        try:
            yield from super().__iter__()
        except Exception as error:
            self._require_workers(error)
            raise

    def _tell_weights(self, policy: TensorDictModuleBase) -> None:
        failures: list[Exception] = []

        def tell() -> None:
            try:
                super(_Processes, self)._tell_weights(policy)
            except Exception as error:
                failures.append(error)

        # Ends with the program where the answer never comes.
        telling = Thread(target=tell, daemon=True)
        telling.start()
        while telling.is_alive():
            telling.join(1.0)
            self._require_workers()
        if failures:
            raise failures[0]

    def _require_workers(self, cause: Exception | None = None) -> None:
        for number, process in enumerate([] if self._running is None else self._running.procs):
            with suppress(ValueError):  # of those that TorchRL has closed
                if not process.is_alive():
                    raise WorkerDiedError(
                        f"collector: worker {number} ended with exit code {process.exitcode} "
                        "before the run; an exit code of -9 often means that the memory was full. "
                        "Take fewer collector.workers, or go on with cnfp-train resume=FOLDER"
                    ) from cause


class MultiSync(_Processes):
    """Batches of all workers together, all with the same weights."""

    def _start(
        self, make_envs: Sequence[MakeEnv], policy: TensorDictModuleBase, frames: int
    ) -> MultiSyncCollector:
        with starting_workers():
            return MultiSyncCollector(
                list(make_envs),
                policy,
                frames_per_batch=self._frames_per_batch * len(make_envs),
                total_frames=frames,
                cat_results="stack",
                auto_register_policy_transforms=False,
            )


class MultiAsync(_Processes):
    """Batches of one worker at a time, which may have acted by the weights before the last."""

    def _start(
        self, make_envs: Sequence[MakeEnv], policy: TensorDictModuleBase, frames: int
    ) -> MultiAsyncCollector:
        with starting_workers():
            return MultiAsyncCollector(
                list(make_envs),
                policy,
                frames_per_batch=self._frames_per_batch,
                total_frames=frames,
                auto_register_policy_transforms=False,
            )


class Ray(WorkerCollector):
    """Batches of all workers together, in a cluster of Ray's.

    Where none is running, one is started on this machine, and stopped at the end.

    Args:
        make_env: See `WorkerCollector`.
        policy: The policy of training.
        memory: Bytes that a worker asks Ray for.
        options: Further arguments of `ray.init`, such as the address of a cluster.
        kwargs: Arguments of `WorkerCollector`.

    Raises:
        ModuleNotFoundError: without the package of the extra ``ray``.
    """

    def __init__(
        self,
        make_env: Callable[[int, int], EnvBase],
        policy: TensorDictModuleBase,
        *,
        memory: int,
        options: dict[str, Any] | None = None,
        **kwargs: Any,
    ) -> None:
        super().__init__(make_env, policy, **kwargs)
        try:
            import ray
        except ModuleNotFoundError as error:
            raise ModuleNotFoundError(
                "collector=ray needs ray; install it with: pip install 'cnfp_torchrl[ray]'",
                name=error.name,
            ) from error
        self._ray, self._memory = ray, memory
        self._options = dict(options or {})
        self._starts_ray = False

    def _start(
        self, make_envs: Sequence[MakeEnv], policy: TensorDictModuleBase, frames: int
    ) -> Any:
        from torchrl.collectors.distributed import RayCollector

        self._starts_ray = not self._ray.is_initialized()
        if self._starts_ray:
            local = {} if "address" in self._options else {"num_cpus": len(make_envs)}
            self._ray.init(**{"include_dashboard": False, **local, **self._options})
        collector = RayCollector(
            list(make_envs),
            policy,
            frames_per_batch=self._frames_per_batch * len(make_envs),
            total_frames=frames,
            sync=True,
            collector_kwargs={"auto_register_policy_transforms": False},
            remote_configs={"num_cpus": 1, "memory": self._memory},
        )
        collector.update_policy_weights_(policy)
        return collector

    def shutdown(self) -> None:
        super().shutdown()
        if self._starts_ray:
            self._ray.shutdown()
            self._starts_ray = False
