"""SAC-Lagrangian against a re-implementation in plain PyTorch, its multipliers, its training."""

from typing import Any

import pytest
import torch
from tensordict import TensorDictBase, TensorDictParams
from torch import Tensor
from torch.nn import functional
from torchrl.objectives import SoftUpdate

from cnfp_torchrl.modules import with_reference_entropy
from cnfp_torchrl.objectives import SACLagrangianLoss
from cnfp_torchrl.training.networks import action_cost_network
from tests.point_nav import SPEC, make_actor, make_critic, same_weights
from tests.training.conftest import TinyRun

# Most tests evaluate a loss once, without stepping its target networks.
pytestmark = pytest.mark.filterwarnings("ignore:No target network updater")

REACHED = {
    "loss_actor": "actor_network",
    "loss_qvalue": "qvalue_network",
    "loss_alpha": "log_alpha",
    "loss_cost": "cost_network",
    "loss_lagrange": "log_lagrange",
}
"""What each loss teaches, and nothing else."""
LOSSES = list(REACHED)


@same_weights()
def make_loss(actor: Any = None, **options: Any) -> SACLagrangianLoss:
    settings = {"thresholds": [0.1, 0.2], "action_spec": SPEC} | options
    networks = actor or make_actor(), make_critic(), action_cost_network(5, 2, 2, hidden=[8])
    return SACLagrangianLoss(*networks, **settings)


@pytest.fixture
def batch(transitions: TensorDictBase) -> TensorDictBase:
    """Transitions of a safe actor, with costs and terminal states invented."""
    generator = torch.Generator().manual_seed(3)
    transitions["next", "cost"] = torch.randint(0, 2, (256, 2), generator=generator).float()
    transitions["next", "terminated"] = torch.rand(256, 1, generator=generator) < 0.2
    return transitions


def total(losses: TensorDictBase) -> Tensor:
    return sum(losses[name] for name in LOSSES)


# Against plain PyTorch ----------------------------------------------------------------------------


def network(params: TensorDictParams, index: int, *inputs: Tensor) -> Tensor:
    """Apply the perceptron of one member of an ensemble of parameters."""
    leaves = dict(params.items(True, True))
    layers = sorted({key[:-1] for key in leaves if key[-1] == "weight"})
    x = torch.cat(inputs, -1)
    for position, layer in enumerate(layers):
        x = x.relu() if position else x
        x = functional.linear(x, leaves[*layer, "weight"][index], leaves[*layer, "bias"][index])
    return x


def costs_of(params: TensorDictParams, index: int, *inputs: Tensor) -> Tensor:
    """Apply a member of the cost critic, whose values are positive."""
    return (1 + network(params, index, *inputs).exp()).log()


def plain_losses(
    loss: SACLagrangianLoss,
    actor: Any,
    batch: TensorDictBase,
    nets: int,
    gammas: tuple[float, float],
) -> dict[str, Tensor]:
    """Return the losses as the docstring's formulas say, drawing in the loss's order."""
    q, q_target = loss.qvalue_network_params, loss.target_qvalue_network_params
    c, c_target = loss.cost_network_params, loss.target_cost_network_params
    seen, after = batch["observation"], batch["next", "observation"]
    goes_on = 1 - batch["next", "terminated"].float()
    alpha, multipliers = loss.log_alpha.exp().detach(), loss.log_lagrange.exp()

    def draw(state: TensorDictBase) -> tuple[Tensor, Tensor]:
        return actor.get_dist(state.clone()).rsample_and_log_prob()

    with torch.no_grad():
        action, log_prob = draw(batch["next"])
        value = torch.minimum(*(network(q_target, i, after, action) for i in range(2)))
        soft = value - alpha * log_prob.unsqueeze(-1)
        target = batch["next", "reward"] + gammas[0] * goes_on * soft
        action, _ = draw(batch["next"])
        later = torch.stack([costs_of(c_target, i, after, action) for i in range(nets)]).amax(0)
        cost_target = batch["next", "cost"] + gammas[1] * goes_on * later
    taken = batch["action"]
    loss_qvalue = sum(
        functional.smooth_l1_loss(network(q, i, seen, taken), target) for i in range(2)
    )
    loss_cost = sum(
        functional.mse_loss(costs_of(c, i, seen, taken)[:, k], cost_target[:, k])
        for i in range(nets)
        for k in range(2)
    )
    action, log_prob = draw(batch)
    fixed_q, fixed_c = q.detach(), c.detach()
    value = torch.minimum(*(network(fixed_q, i, seen, action) for i in range(2))).squeeze(-1)
    costs = torch.stack([costs_of(fixed_c, i, seen, action) for i in range(nets)]).amax(0)
    price = sum(multipliers[k].detach() * costs[:, k] for k in range(2))
    excess = costs.mean(0).detach() - torch.tensor([0.1, 0.2])
    return {
        "loss_actor": (alpha * log_prob - value + price).mean(),
        "loss_qvalue": loss_qvalue,
        "loss_alpha": -(loss.log_alpha * (log_prob.detach() - 2)).mean(),
        "loss_cost": loss_cost,
        "loss_lagrange": -(multipliers * excess).sum(),
        "cost_value_0": costs[:, 0].mean().detach(),
        "cost_value_1": costs[:, 1].mean().detach(),
    }


@pytest.mark.parametrize("nets", [1, 3])
@pytest.mark.parametrize("entropy", ["reference", "action"])
@pytest.mark.parametrize("flow", ["exact", "unconstrained"])
@pytest.mark.parametrize("deactivate_vmap", [False, True])
def test_values_and_gradients_are_those_of_the_formulas(
    batch: TensorDictBase,
    nets: int,
    entropy: str,
    flow: str,
    deactivate_vmap: bool,
) -> None:
    actor = make_actor(flow=flow)
    loss = make_loss(
        actor,
        entropy=entropy,
        gamma=0.9,
        gamma_cost=0.8,
        lambda_init=2.0,
        num_cost_nets=nets,
        deactivate_vmap=deactivate_vmap,
    )
    with torch.no_grad():
        loss.log_lagrange[1] = -0.5
        for name in ("target_qvalue_network_params", "target_cost_network_params"):
            for value in getattr(loss, name).values(True, True):
                value.add_(0.1 * torch.randn_like(value))
    torch.manual_seed(1)
    losses = loss(batch.clone())
    torch.manual_seed(1)
    scored = with_reference_entropy(actor) if entropy == "reference" else actor
    expected = plain_losses(loss, scored, batch, nets, (0.9, 0.8))
    assert set(losses.keys()) == set(loss.out_keys)
    for name, value in expected.items():
        torch.testing.assert_close(losses[name], value, rtol=1e-4, atol=1e-5, msg=name)
    assert float(losses["lambda_0"]) == pytest.approx(2.0)
    assert float(losses["lambda_1"]) == pytest.approx(torch.tensor(-0.5).exp().item())

    parameters = {
        name: parameter for name, parameter in loss.named_parameters() if parameter.requires_grad
    }
    for name in LOSSES:
        mine, theirs = (
            torch.autograd.grad(
                result[name],
                list(parameters.values()),
                retain_graph=True,
                allow_unused=True,
                materialize_grads=True,
            )
            for result in (losses, expected)
        )
        for key, a, b in zip(parameters, mine, theirs, strict=True):
            torch.testing.assert_close(a, b, rtol=1e-3, atol=1e-5, msg=f"{name}: {key}")
        reached = {
            key.partition("_params")[0]
            for key, gradient in zip(parameters, mine, strict=True)
            if gradient.any()
        }
        assert reached == {REACHED[name]}, name


# Multipliers --------------------------------------------------------------------------------------


def test_multipliers_rise_above_the_threshold_and_fall_below() -> None:
    loss = make_loss(lambda_init=1.0, lambda_max=3.0)
    optimizer = torch.optim.Adam([loss.log_lagrange], lr=0.1)
    history = [loss.multipliers]
    for _ in range(40):
        optimizer.zero_grad()
        loss.lagrange_loss(torch.tensor([0.5, 0.1])).backward()
        optimizer.step()
        history.append(loss.multipliers)
        assert (history[-1] <= 3.0).all()
        assert (history[-1] > 0).all()
    risen, fallen = torch.stack(history).unbind(-1)
    assert (risen.diff() >= 0).all()
    assert (fallen.diff() < 0).all()
    assert float(risen[-1]) == pytest.approx(3.0)
    assert fallen[-1] < 0.2
    # What pushed against the bound has left no debt behind it.
    loss.log_lagrange.grad = None
    loss.lagrange_loss(torch.tensor([0.0, 0.1])).backward()
    torch.optim.SGD([loss.log_lagrange], lr=0.5).step()
    assert loss.multipliers[0] < 3.0


def test_a_threshold_at_the_cost_changes_nothing() -> None:
    loss = make_loss()
    loss.lagrange_loss(loss.thresholds.clone()).backward()
    assert not loss.log_lagrange.grad.any()


@pytest.mark.parametrize("bound", [1e-3, 0.1, 7.0, 100.0, 12345.0])
def test_the_bound_holds_exactly(bound: float) -> None:
    loss = make_loss(lambda_init=bound, lambda_max=bound)
    with torch.no_grad():
        loss.log_lagrange.fill_(50.0)
    assert (loss.multipliers <= bound).all()
    torch.testing.assert_close(loss.multipliers, torch.full((2,), bound))


# Training -----------------------------------------------------------------------------------------


def test_the_cost_critic_s_target_follows(batch: TensorDictBase) -> None:
    loss = make_loss()
    target = SoftUpdate(loss, tau=0.25)
    before = loss.target_cost_network_params.data.clone()
    total(loss(batch)).backward()
    torch.optim.Adam(loss.parameters(), lr=0.1).step()
    online = loss.cost_network_params.data.clone()
    target.step()
    after = loss.target_cost_network_params.data
    for key, value in (before * 0.75 + online * 0.25).items(True, True):
        torch.testing.assert_close(after[key], value)
        assert not torch.equal(after[key], before[key])


def test_the_cost_critic_learns_the_discounted_costs(batch: TensorDictBase) -> None:
    loss = make_loss(gamma_cost=0.5)
    batch["next", "cost"][:, 0], batch["next", "cost"][:, 1] = 1.0, 0.0
    batch["next", "terminated"][:] = False
    target = SoftUpdate(loss, tau=0.2)
    optimizer = torch.optim.Adam(loss.cost_network_params.parameters(), lr=0.02)
    for _ in range(200):
        optimizer.zero_grad()
        loss.cost_loss(batch).backward()
        optimizer.step()
        target.step()
    losses = loss(batch)
    assert float(losses["cost_value_0"]) == pytest.approx(2.0, abs=0.2)  # 1 / (1 - 0.5)
    assert float(losses["cost_value_1"]) == pytest.approx(0.0, abs=0.2)


def test_the_cost_critic_learns_a_mean_of_rare_costs(batch: TensorDictBase) -> None:
    # A robust loss would learn something like the median, 0.5 where the mean is 2.
    loss = make_loss(gamma_cost=0.0)
    batch["observation"][:] = 0.0
    batch["action"][:] = 0.0
    batch["next", "cost"] = 10.0 * (torch.arange(512).reshape(256, 2) % 5 == 0)
    optimizer = torch.optim.Adam(loss.cost_network_params.parameters(), lr=0.02)
    for _ in range(300):
        optimizer.zero_grad()
        loss.cost_loss(batch).backward()
        optimizer.step()
    learned = costs_of(loss.cost_network_params, 0, batch["observation"], batch["action"])
    torch.testing.assert_close(learned.mean(0), batch["next", "cost"].mean(0), rtol=0, atol=0.1)


def test_costs_are_never_promised_to_be_negative(batch: TensorDictBase) -> None:
    loss = make_loss()
    with torch.no_grad():
        for value in loss.cost_network_params.values(True, True):
            value.fill_(-1.0)  # every value below 0, without a last layer that prevents it
    losses = loss(batch)
    assert float(losses["cost_value_0"]) >= 0
    assert float(losses["cost_value_1"]) >= 0


def test_a_price_moves_the_actor_away_from_costs(batch: TensorDictBase) -> None:
    loss = make_loss(lambda_init=1000.0, lambda_max=1000.0)
    optimizer = torch.optim.Adam(loss.actor_network_params.parameters(), lr=0.01)
    costs = []
    for _ in range(30):
        optimizer.zero_grad()
        value, metadata = loss.actor_loss(batch)
        value.backward()
        optimizer.step()
        costs.append(float(metadata["cost_value"].sum(-1).mean()))
    assert costs[-1] < costs[0] - 0.01


def test_it_survives_saving_and_loading(batch: TensorDictBase) -> None:
    first = make_loss()
    with torch.no_grad():
        first.log_lagrange.fill_(0.7)
    second = make_loss()
    second.load_state_dict(first.state_dict())
    results = []
    for loss in (first, second):
        torch.manual_seed(2)
        results.append(loss(batch.clone()))
    for name, value in results[0].items():
        torch.testing.assert_close(results[1][name], value, msg=name)


def test_costs_are_read_under_another_key(batch: TensorDictBase) -> None:
    loss = make_loss()
    loss.set_keys(cost="harm")
    assert ("next", "harm") in loss.in_keys
    batch.rename_key_(("next", "cost"), ("next", "harm"))
    assert loss(batch)["loss_cost"].isfinite()


# Settings -----------------------------------------------------------------------------------------


def test_one_threshold_is_that_of_all_constraints() -> None:
    loss = make_loss(thresholds=0.3, constraint_names=["obstacle", "battery"])
    assert loss.thresholds.tolist() == pytest.approx([0.3, 0.3])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"thresholds": []}, r"thresholds: expected one number for each .*given \[\]"),
        (
            {"thresholds": [0.1], "constraint_names": ["obstacle", "battery"]},
            r"thresholds: expected one number .*\['obstacle', 'battery'\], given \[0.1\]",
        ),
        ({"thresholds": [0.1, -1.0]}, r"thresholds: expected numbers >= 0, given \[0.1, -1.0\]"),
        ({"thresholds": [0.1, float("nan")]}, "thresholds: expected numbers >= 0"),
        ({"gamma_cost": 1.0}, r"gamma_cost: expected a discount in \[0, 1\), given 1.0"),
        ({"lambda_max": 0.0}, "lambda_max: expected a number > 0, given 0.0"),
        ({"lambda_max": float("inf")}, "lambda_max: expected a number > 0, given inf"),
        ({"lambda_init": 200.0}, r"lambda_init: expected .*lambda_max = 100.0\], given 200.0"),
        ({"lambda_init": 0.0}, "lambda_init: expected a number in .* given 0.0"),
        ({"num_cost_nets": 0}, "num_cost_nets: expected a number >= 1, given 0"),
        ({"reduction": "none"}, "reduction: expected 'mean' or 'sum', given 'none'"),
        ({"skip_done_states": True}, "skip_done_states: expected it left out"),
        ({"entropy": "none"}, "entropy: expected 'reference' or 'action', given 'none'"),
    ],
)
def test_bad_settings_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_loss(**options)


def test_costs_of_another_shape_are_refused(batch: TensorDictBase) -> None:
    with pytest.raises(ValueError, match=r"cost_network: .*\['0', '1', '2'\], given 2"):
        make_loss(thresholds=[0.1] * 3)(batch.clone())
    batch["next", "cost"] = torch.zeros(256, 3)
    with pytest.raises(ValueError, match=r"'cost'\): .*shape \(256, 2\), given \(256, 3\)"):
        make_loss()(batch.clone())


# As methods of the trainer ------------------------------------------------------------------------


def test_the_lagrangian_is_logged_by_name_and_trained(tiny_run: TinyRun) -> None:
    folder, _ = tiny_run("experiment=lagrangian", "logger=csv")
    scalars = folder.path / "metrics" / "scalars"
    for name in (
        "loss/cost",
        "loss/lagrange",
        "train/lambda_obstacle",
        "train/cost_value_battery",
    ):
        _, value = (scalars / f"{name}.csv").read_text().splitlines()[-1].split(",")
        assert torch.isfinite(torch.tensor(float(value)))
    state = folder.load_checkpoint()["loss"]
    assert (state["log_lagrange"] != 0).all()


def test_thresholds_of_another_number_are_refused_by_name(tiny_run: TinyRun) -> None:
    with pytest.raises(Exception, match=r"\['obstacle', 'battery'\], given \[0.0\]"):
        tiny_run("experiment=lagrangian", "loss.thresholds=[0.0]")
