"""The SAC loss with batched critics against TorchRL's SACLoss, for the same weights and noise."""

import copy
import warnings
from collections.abc import Callable
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.data import Bounded
from torchrl.modules import (
    MLP,
    NormalParamExtractor,
    ProbabilisticActor,
    TanhNormal,
    ValueOperator,
)
from torchrl.objectives import SACLoss, SoftUpdate, ValueEstimators

from cnfp_torchrl.modules import ScaledNetwork, with_reference_entropy
from cnfp_torchrl.objectives import BatchedSACLoss
from cnfp_torchrl.objectives.stacked_perceptron import StackedPerceptron
from cnfp_torchrl.training.networks import action_cost_network, action_value_network
from tests.copies import EVERY_COPY
from tests.point_nav import make_actor

pytestmark = pytest.mark.filterwarnings("ignore:No target network updater")

LOSSES = ("loss_actor", "loss_qvalue", "loss_alpha")
SPEC = Bounded(-torch.ones(2), torch.ones(2))


class OwnCritic(nn.Module):
    """A network that is no perceptron in a sequence."""

    def __init__(self) -> None:
        super().__init__()
        self.first, self.last = nn.Linear(7, 8), nn.Linear(8, 1)

    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        return self.last(self.first(torch.cat([observation, action], -1)).sin())


def perceptron(*layers: nn.Module) -> ValueOperator:
    joint = MLP(in_features=7, out_features=1, num_cells=[8], activation_class=nn.Tanh)
    return ValueOperator(
        nn.Sequential(*layers) if layers else joint, in_keys=["observation", "action"]
    )


CRITICS: dict[str, Callable[[], ValueOperator]] = {
    "perceptron": lambda: action_value_network(5, 2, hidden=[8, 8]),
    "tanh": perceptron,
    "of its own": lambda: ValueOperator(OwnCritic(), in_keys=["observation", "action"]),
    "normalized": lambda: ValueOperator(
        MLP(
            in_features=7,
            out_features=1,
            num_cells=[8],
            norm_class=nn.LayerNorm,
            norm_kwargs={"normalized_shape": 8},
        ),
        in_keys=["observation", "action"],
    ),
}
BATCHED = {"perceptron", "tanh"}


def tanh_normal_actor() -> ProbabilisticActor:
    network = nn.Sequential(nn.Linear(5, 8), nn.ReLU(), nn.Linear(8, 4), NormalParamExtractor())
    return ProbabilisticActor(
        TensorDictModule(network, ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        spec=SPEC,
        distribution_class=TanhNormal,
        return_log_prob=True,
    )


def make_any_actor(kind: str) -> Any:
    if kind == "TanhNormal":
        return tanh_normal_actor()
    flow, _, reference = kind.partition(", ")
    actor = make_actor(flow=flow)
    return with_reference_entropy(actor) if reference else actor


@pytest.fixture
def batch(transitions: TensorDictBase) -> TensorDictBase:
    """Transitions with terminal and truncated states and other rewards."""
    generator = torch.Generator().manual_seed(3)
    terminated, truncated = torch.rand(2, 256, 1, generator=generator) < 0.2
    outcome = transitions["next"]
    outcome["terminated"], outcome["done"] = terminated, terminated | truncated
    outcome["reward"] = torch.randn(256, 1, generator=generator)
    return transitions


def both(
    actor: Any, critic: Any, *, estimator: dict[str, Any] | None = None, **options: Any
) -> list[SACLoss]:
    """Return TorchRL's loss and ours with the same weights, also of the targets."""
    losses = [
        make(actor, critic, action_spec=SPEC, **options) for make in (SACLoss, BatchedSACLoss)
    ]
    generator = torch.Generator().manual_seed(4)
    with torch.no_grad():
        for name in ("qvalue_network_params", "target_qvalue_network_params"):
            for leaf in getattr(losses[0], name).values(True, True):
                leaf.copy_(torch.randn(leaf.shape, generator=generator) / leaf.shape[-1] ** 0.5)
    for loss in losses:
        loss.make_value_estimator(
            **(estimator or {"value_type": ValueEstimators.TD0, "gamma": 0.9})
        )
    losses[1].load_state_dict(losses[0].state_dict())
    return losses


def assert_equal(losses: list[SACLoss], batch: TensorDictBase) -> None:
    """Compare outputs, what is written to the batch, and all gradients of all losses."""
    outputs, batches, gradients = [], [], []
    for loss in losses:
        batches.append(batch.clone())
        torch.manual_seed(1)
        outputs.append(loss(batches[-1]))
        parameters = dict(loss.named_parameters())
        for name in LOSSES:
            value = outputs[-1][name].sum()
            if not value.requires_grad:
                continue
            found = torch.autograd.grad(
                value, list(parameters.values()), retain_graph=True, allow_unused=True
            )
            gradients.append({(name, key): g for key, g in zip(parameters, found, strict=True)})
    assert set(outputs[0].keys()) == set(outputs[1].keys())
    for name, expected in outputs[0].items():
        torch.testing.assert_close(outputs[1][name], expected, rtol=1e-4, atol=1e-5, msg=name)
    # SACLoss also leaves the actor's location and scale there.
    assert set(batches[1].keys(True, True)) <= set(batches[0].keys(True, True))
    priority = losses[0].tensor_keys.priority
    torch.testing.assert_close(batches[1][priority], batches[0][priority], rtol=1e-4, atol=1e-5)
    half = len(gradients) // 2
    for theirs, mine in zip(gradients[:half], gradients[half:], strict=True):
        for key, expected in theirs.items():
            if expected is None:
                assert mine[key] is None or not mine[key].any(), key
            else:
                scale = float(expected.abs().max())
                torch.testing.assert_close(
                    mine[key], expected, rtol=1e-3, atol=1e-5 * max(scale, 1), msg=str(key)
                )


# Values and gradients -----------------------------------------------------------------------------


@pytest.mark.parametrize("critic", CRITICS)
@pytest.mark.parametrize(
    "actor", ["TanhNormal", "unconstrained", "exact", "exact, reference", "squash", "radial"]
)
def test_it_equals_torchrl_s_for_any_actor_and_critic(
    batch: TensorDictBase, actor: str, critic: str
) -> None:
    losses = both(make_any_actor(actor), CRITICS[critic]())
    assert_equal(losses, batch)
    applied = losses[1]._ensembles["qvalue_network"]
    assert isinstance(applied, StackedPerceptron) == (critic in BATCHED)


OPTIONS: dict[str, dict[str, Any]] = {
    "fixed alpha": {"fixed_alpha": True, "alpha_init": 0.2},
    "learned alpha from .2": {"alpha_init": 0.2},
    "bounded alpha": {"alpha_init": 5.0, "min_alpha": 0.5, "max_alpha": 2.0},
    "target entropy": {"target_entropy": -7.0},
    "one critic": {"num_qvalue_nets": 1},
    "five critics": {"num_qvalue_nets": 5},
    "l2": {"loss_function": "l2"},
    "l1": {"loss_function": "l1"},
    "sum": {"reduction": "sum"},
    "each": {"reduction": "none", "scalar_output_mode": "exclude"},
    "no target critics": {"delay_qvalue": False},
    "no vmap": {"deactivate_vmap": True},
    "ended states skipped": {"skip_done_states": True},
}


@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS)
def test_it_equals_torchrl_s_for_any_option(batch: TensorDictBase, options: dict[str, Any]) -> None:
    critic = CRITICS["perceptron"]()
    assert_equal(both(make_any_actor("exact, reference"), critic, **options), batch)


@pytest.mark.parametrize(
    "estimator",
    [
        {"value_type": ValueEstimators.TD0, "gamma": 0.0},
        {"value_type": ValueEstimators.TD0, "gamma": 0.5, "average_rewards": True},
        {"value_type": ValueEstimators.TDLambda, "gamma": 0.9, "lmbda": 0.8},
    ],
)
def test_it_equals_torchrl_s_for_any_value_estimator(
    batch: TensorDictBase, estimator: dict[str, Any]
) -> None:
    critic = CRITICS["perceptron"]()
    losses = both(make_any_actor("unconstrained"), critic, estimator=estimator)
    assert_equal(losses, batch.reshape(16, 16))


def test_it_equals_torchrl_s_with_several_steps_priorities_and_masks(batch: TensorDictBase) -> None:
    losses = both(make_any_actor("unconstrained"), CRITICS["perceptron"]())
    batch["steps_to_next_obs"] = torch.randint(1, 4, (256, 1))
    assert_equal(losses, batch)
    batch["priority_weight"] = torch.rand(256)
    assert_equal(losses, batch)
    batch["collector", "mask"] = torch.rand(256) < 0.5
    assert_equal(losses, batch)


@pytest.mark.parametrize("shape", [(256,), (1, 256), (8, 32), (2, 16, 8)])
def test_it_equals_torchrl_s_for_any_batch_shape(
    batch: TensorDictBase, shape: tuple[int, ...]
) -> None:
    losses = both(make_any_actor("exact"), CRITICS["perceptron"]())
    assert_equal(losses, batch.reshape(shape))


@pytest.mark.parametrize("size", [1, 7, 8, 10])
def test_it_equals_torchrl_s_for_any_number_of_transitions(
    batch: TensorDictBase, size: int
) -> None:
    losses = both(make_any_actor("exact, reference"), CRITICS["perceptron"]())
    assert_equal(losses, batch[:size])


def test_it_equals_torchrl_s_in_float64(batch: TensorDictBase) -> None:
    losses = both(make_any_actor("TanhNormal"), CRITICS["perceptron"]())
    for loss in losses:
        loss(batch.clone())  # what it remembers of before is not taken for what comes after
    losses = [loss.double() for loss in losses]
    assert_equal(losses, batch.apply(lambda x: x.double() if x.is_floating_point() else x))


def test_it_equals_torchrl_s_under_other_keys(batch: TensorDictBase) -> None:
    losses = both(make_any_actor("unconstrained"), CRITICS["perceptron"]())
    renamed = {"reward": "gain", "terminated": "over", "done": "ended", "priority": "surprise"}
    for name, other in renamed.items():
        if name != "priority":
            batch.rename_key_(("next", name), ("next", other))
    for loss in losses:
        loss.set_keys(**renamed)
    assert set(losses[0].in_keys) == set(losses[1].in_keys)
    assert losses[0].out_keys == losses[1].out_keys
    assert_equal(losses, batch)


@pytest.mark.parametrize("batched", [True, False])
def test_critics_write_under_another_key(batch: TensorDictBase, batched: bool) -> None:
    network = MLP(in_features=7, out_features=1, num_cells=[8]) if batched else OwnCritic()
    critic = TensorDictModule(network, ["observation", "action"], ["value"])
    losses = both(make_any_actor("unconstrained"), critic)
    with pytest.raises(KeyError, match=r"qvalue_network: expected .*'state_action_value', given"):
        losses[1](batch.clone())
    for loss in losses:
        loss.set_keys(state_action_value="value")
    assert_equal(losses, batch)


def test_it_is_called_with_tensors(batch: TensorDictBase) -> None:
    results = []
    for loss in both(make_any_actor("unconstrained"), CRITICS["perceptron"]()):
        torch.manual_seed(1)
        entries = {"_".join(k) if isinstance(k, tuple) else k: batch[k] for k in loss.in_keys}
        loss.select_out_keys("loss_actor", "loss_qvalue")
        results.append(loss(**entries))
    for mine, theirs in zip(*results, strict=True):
        torch.testing.assert_close(mine, theirs)


# Life of the module -------------------------------------------------------------------------------


def trained(loss: SACLoss, batch: TensorDictBase, updates: int = 20) -> SACLoss:
    """Return the loss after some updates with noise of a seed."""
    with warnings.catch_warnings(action="ignore"):
        target = SoftUpdate(loss, tau=0.1)
    optimizer = torch.optim.Adam(loss.parameters(), lr=3e-3)
    torch.manual_seed(5)
    for _ in range(updates):
        losses = loss(batch.clone())
        optimizer.zero_grad()
        sum(losses[name] for name in LOSSES).backward()
        optimizer.step()
        target.step()
    return loss


def test_training_goes_as_with_torchrl_s(batch: TensorDictBase) -> None:
    actor = make_any_actor("exact")
    losses = both(actor, CRITICS["perceptron"]())
    ours = both(copy.deepcopy(actor), CRITICS["perceptron"]())[1]
    ours.load_state_dict(losses[0].state_dict())
    states = [trained(loss, batch).state_dict() for loss in (losses[0], ours)]
    assert list(states[0]) == list(states[1])
    for key, expected in states[0].items():
        torch.testing.assert_close(states[1][key], expected, rtol=1e-2, atol=1e-3, msg=key)


@EVERY_COPY
@pytest.mark.parametrize("critic", ["perceptron", "of its own"])
def test_a_copy_learns_and_leaves_the_original_alone(
    batch: TensorDictBase, critic: str, copied: Callable[[Any], Any]
) -> None:
    first = both(make_any_actor("exact"), CRITICS[critic]())[1]
    first(batch.clone())  # so that it remembers something
    before = {key: value.clone() for key, value in first.state_dict().items()}
    second = copied(first)
    assert_equal([first, second], batch)
    trained(second, batch, 2)
    for key, value in first.state_dict().items():
        assert torch.equal(value, before[key]), key
    changed = [key for key, value in second.state_dict().items() if (value != before[key]).any()]
    assert {key.split(".")[0] for key in changed} == {
        "actor_network_params",
        "qvalue_network_params",
        "target_qvalue_network_params",
        "log_alpha",
    }
    # The copy's passes see its own weights: a fresh loss with them says the same.
    fresh = both(make_any_actor("exact"), CRITICS[critic]())[0]
    fresh.load_state_dict(second.state_dict())
    assert_equal([fresh, second], batch)


def test_it_survives_saving_and_loading(batch: TensorDictBase) -> None:
    first = trained(both(make_any_actor("exact"), CRITICS["perceptron"]())[1], batch, 2)
    second = BatchedSACLoss(make_any_actor("exact"), CRITICS["perceptron"](), action_spec=SPEC)
    second.make_value_estimator(ValueEstimators.TD0, gamma=0.9)
    second(batch.clone())  # what it remembers of before is not taken for what comes after
    second.load_state_dict(first.state_dict(), assign=True)
    assert_equal([first, second], batch)


def test_the_caller_s_tensordict_gains_the_priority_alone(batch: TensorDictBase) -> None:
    loss = both(make_any_actor("exact"), CRITICS["perceptron"]())[1]
    before = batch.clone()
    loss(batch)
    assert set(batch.keys(True, True)) - set(before.keys(True, True)) == {"td_error"}
    for key in before.keys(True, True):
        assert torch.equal(batch[key], before[key]), key


# The batched product ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("network", "inputs"),
    [
        (nn.Linear(3, 2), 3),
        (nn.Linear(3, 2, bias=False), 3),
        (ScaledNetwork([150.0, 0.1, 1.0], nn.Sequential(nn.Linear(3, 2), nn.Tanh())), 3),
        (nn.Sequential(nn.Linear(3, 4), nn.Sequential(nn.SiLU(), nn.Linear(4, 2, bias=False))), 3),
        (MLP(in_features=3, out_features=2, num_cells=[5, 4], activation_class=nn.ELU), 3),
        (action_cost_network(2, 1, 2, hidden=[4]).module, 3),
    ],
)
@pytest.mark.parametrize("batch", [(), (6,), (2, 3)])
def test_stacked_networks_are_the_networks(
    network: nn.Module, inputs: int, batch: tuple[int, ...]
) -> None:
    stacked = StackedPerceptron.of(network)
    assert stacked is not None
    members = [copy.deepcopy(network) for _ in range(3)]
    for member in members:
        for parameter in member.parameters():
            nn.init.normal_(parameter)
    weights = {
        name: torch.stack([member.state_dict(keep_vars=True)[name] for member in members])
        for name in network.state_dict()
    }
    given = torch.randn(*batch, inputs, requires_grad=True)
    expected, mine = torch.stack([member(given) for member in members]), stacked(given, weights)
    torch.testing.assert_close(mine, expected)
    direction = torch.randn_like(expected)
    theirs = torch.autograd.grad((expected * direction).sum(), given)
    torch.testing.assert_close(torch.autograd.grad((mine * direction).sum(), given), theirs)


def test_compiled_rectifiers_are_relu_s(fresh_compiler: None) -> None:
    stacked = StackedPerceptron([nn.ReLU()])
    given = torch.tensor([[0.0, -0.0, 2.0, -3.0, 1e-40, 1e30, torch.inf]], requires_grad=True)

    @torch.compile(backend="eager")
    def compiled(values: Tensor) -> Tensor:
        return stacked(values, {})

    for values in (compiled(given), stacked(given, {})):
        (gradient,) = torch.autograd.grad(values.sum(), given)
        assert values.tolist() == [[0, 0, 2, 0, given[0, 4].item(), given[0, 5].item(), torch.inf]]
        assert gradient.tolist() == [[0, 0, 1, 0, 1, 1, 1]]


def hooked() -> nn.Module:
    network = nn.Sequential(nn.Linear(3, 2))
    network[0].register_forward_hook(lambda module, given, result: 2 * result)
    return network


@pytest.mark.parametrize(
    "network",
    [
        OwnCritic(),
        nn.Sequential(nn.Linear(3, 4), nn.Dropout(), nn.Linear(4, 1)),
        nn.Sequential(nn.Linear(3, 4), nn.Softmax(-1)),
        nn.Sequential(nn.Linear(3, 4), nn.PReLU()),
        nn.Sequential(nn.LazyLinear(3)),
        nn.utils.parametrizations.spectral_norm(nn.Linear(3, 2)),
        MLP(in_features=3, out_features=(2, 2), num_cells=[4]),
        hooked(),
        nn.Sequential(),
    ],
    ids=lambda network: type(network).__name__,
)
def test_other_networks_are_left_to_vmap(network: nn.Module) -> None:
    assert StackedPerceptron.of(network) is None


def test_the_base_of_the_comparison_is_sensitive(batch: TensorDictBase) -> None:
    losses = both(make_any_actor("unconstrained"), CRITICS["perceptron"]())
    with torch.no_grad():
        next(iter(losses[1].target_qvalue_network_params.values(True, True)))[1].mul_(1.01)
    with pytest.raises(AssertionError):
        assert_equal(losses, batch)


def test_tensordicts_of_other_entries_are_fine() -> None:
    """Observations without geometry, on an actor that needs none, as any TorchRL user has them."""
    data = TensorDict(
        {
            "observation": torch.randn(32, 5),
            "action": SPEC.rand((32,)),
            "next": {
                "observation": torch.randn(32, 5),
                "reward": torch.randn(32, 1),
                "done": torch.zeros(32, 1, dtype=torch.bool),
                "terminated": torch.zeros(32, 1, dtype=torch.bool),
            },
        },
        [32],
    )
    assert_equal(both(tanh_normal_actor(), CRITICS["perceptron"]()), data)
