r"""Constrained actors split at the latent, for PPO and for deterministic policies such as TD3's.

The flow :math:`a = f(z)` has no parameters, so a stored latent determines the action, and is exact
where the action is rounded. PPO's ratio is that of the latents' densities, because the
log-determinants cancel, :math:`\pi_{new}(a|s) / \pi_{old}(a|s) = p_{new}(z|s) / p_{old}(z|s)`,
whereas the inversion of a saturated float32 action loses the latent. Exploration noise added to the
latent is mapped to an allowed action; added to the action it breaks the constraints.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

from tensordict import TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictSequential,
    TensorDictModuleBase,
    TensorDictSequential,
)
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.modules import (
    IndependentNormal,
    SafeProbabilisticModule,
    SafeProbabilisticTensorDictSequential,
)

from cnfp_torchrl.distributions import ConstrainedFlow
from cnfp_torchrl.keys import LATENT_KEY, LATENT_LOG_PROB_KEY, require
from cnfp_torchrl.modules.actors import actor_modules, flow_head
from cnfp_torchrl.modules.flow_module import ConstrainedFlowModule, refuse_other_batch


class FlowMap(TensorDictModuleBase):
    """Map a latent to an allowed action by the flow of a `ConstrainedFlowModule`, without sampling.

    It has no parameters. A deterministic policy is a network that writes the latent, exploration
    noise on the latent, and this map; a critic that reads latents is this map and a critic of
    actions (``experiments/examples/td3_latent_noise.py``).

    Args:
        head: The flow module of a constrained actor (`flow_head`), or one made for this purpose,
            ``ConstrainedFlowModule(spec, bijectors)``.
        latent_key: The key of the latent ``(*batch, d)``.

    Raises:
        ValueError: when called on latents of another dimension than the action.
        MissingGeometryError: when called without a latent, or without the geometry.
    """

    def __init__(self, head: ConstrainedFlowModule, latent_key: NestedKey = LATENT_KEY) -> None:
        super().__init__()
        self.head = head
        self.latent_key = latent_key
        self.in_keys = [latent_key, *head.geometry_keys()]
        self.out_keys = [head.action_key]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action ``(*batch, d)``."""
        latent = require(tensordict, self.latent_key, "put a module that writes it before the map")
        if latent.shape[-1:] != (self.head.action_dim,):
            raise ValueError(
                f"key {self.latent_key!r}: expected latents of {self.head.action_dim} "
                f"components, as the action has, given shape {tuple(latent.shape)}"
            )
        bijector = self.head.get_bijector(tensordict)
        if self.head.flow.reads_constraints:
            refuse_other_batch(self.latent_key, latent, bijector.shape[:-1])
        return tensordict.set(self.head.action_key, bijector(self.head.widened(latent)))


class LatentGaussian(IndependentNormal):
    """The Gaussian under a flow: a distribution over latents, with the entropy of the actions.

    Args:
        flow: The distribution over actions; its base must be a Gaussian.
    """

    def __init__(self, flow: ConstrainedFlow) -> None:
        independent: Any = flow.base_dist
        gaussian = independent.base_dist
        super().__init__(gaussian.loc, gaussian.scale, validate_args=False)
        self.flow = flow

    def entropy(self) -> Tensor:
        """Return a one-sample estimate of the action's entropy, ``(*batch,)``, with its gradient.

        The latent's own entropy is rejected: an entropy bonus would widen the Gaussian without end,
        while all actions gather at the boundary.
        """
        return -self.flow.rsample_and_log_prob()[1]


class LatentScorer(SafeProbabilisticModule):
    """The Gaussian under a flow as the last module of an actor, for losses.

    Args:
        head: The flow module.
        kwargs: Options of `torchrl.modules.SafeProbabilisticModule`.
    """

    def __init__(self, head: ConstrainedFlowModule, **kwargs: Any) -> None:
        super().__init__(distribution_class=LatentGaussian, **kwargs)
        self.head = head
        self.in_keys = list(head.in_keys)

    def get_dist(self, tensordict: TensorDictBase) -> LatentGaussian:
        """Return the distribution over latents in the states of a tensordict."""
        return LatentGaussian(self.head.get_dist(tensordict))

    build_dist_from_params = get_dist

    def named_modules(self, *args: Any, **kwargs: Any) -> Iterator[tuple[str, nn.Module]]:
        """Yield the modules without the flow module, which is a part of the distribution.

        tensordict takes the last probabilistic module of an actor for its distribution, and losses
        count such modules.
        """
        for name, module in super().named_modules(*args, **kwargs):
            if module is not self.head:
                yield name, module


class LatentActor(NamedTuple):
    """A constrained actor split at its latent; the networks are the actor's own.

    Args:
        policy: The policy for collectors and environments, which writes latent and log-density,
            then the action.
        base: The actor up to the latent, which scores stored ones: ``actor_network`` of a loss.
    """

    policy: TensorDictSequential
    base: SafeProbabilisticTensorDictSequential


def split_at_latent(
    actor: ProbabilisticTensorDictSequential,
    *,
    latent_key: NestedKey = LATENT_KEY,
    log_prob_key: NestedKey = LATENT_LOG_PROB_KEY,
) -> LatentActor:
    """Return a constrained actor as a policy that stores its latents, and a view that scores them.

    For losses that score stored samples, such as `torchrl.objectives.ClipPPOLoss`::

        policy, base = split_at_latent(actor)
        collector = Collector(env, policy, ...)
        loss = ClipPPOLoss(base, critic)

    The ratios are exact however saturated the actions are, and so are divergences between two
    policies, which the flow leaves as they are. The entropy bonus is a Monte-Carlo estimate of the
    action's entropy, one sample a state whatever ``samples_mc_entropy``. For the reference entropy
    pass ``with_reference_entropy(actor)``; for none, give the loss ``entropy_bonus=False``.

    Args:
        actor: A constrained actor; parameters are shared, not copied.
        latent_key: The key of the latents ``(*batch, d)``.
        log_prob_key: The key of their log-densities ``(*batch,)``.

    Raises:
        TypeError: when the actor does not end in a `ConstrainedFlowModule`.
    """
    head = flow_head(actor)
    body = actor_modules(actor)[:-1]
    options: dict[str, Any] = {
        "in_keys": list(head.parameter_keys),
        "out_keys": [latent_key],
        "return_log_prob": True,
        "log_prob_key": log_prob_key,
        "default_interaction_type": head.default_interaction_type,
        "num_samples": head.num_samples,
    }
    # Not LatentScorer, which would build the flow of each state a second time.
    sampler = SafeProbabilisticModule(distribution_class=IndependentNormal, **options)
    return LatentActor(
        policy=TensorDictSequential(*body, sampler, FlowMap(head, latent_key)),
        base=SafeProbabilisticTensorDictSequential(*body, LatentScorer(head, **options)),
    )
