import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import CatTensors, Compose, GymEnv, SerialEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs

from cnfp_torchrl.envs import PreviousAction
from cnfp_torchrl.tasks.point_nav import PointNavEnv


def test_a_state_shows_the_action_that_led_to_it_and_zero_after_a_reset() -> None:
    env = TransformedEnv(PointNavEnv([3], max_steps=4, seed=0), PreviousAction())
    check_env_specs(env, seed=0)
    steps = env.rollout(10, break_when_any_done=False)
    before, action = steps["previous_action"], steps["action"]
    assert (before.dtype, before.shape) == (action.dtype, action.shape)
    torch.testing.assert_close(steps["next", "previous_action"], action, rtol=0, atol=0)
    starts = torch.arange(10) % 4 == 0
    assert (before[:, starts] == 0).all()
    torch.testing.assert_close(before[:, 1:][:, ~starts[1:]], action[:, :-1][:, ~starts[1:]])


def test_agents_that_are_not_reset_keep_theirs() -> None:
    env = TransformedEnv(PointNavEnv([2], seed=0), PreviousAction(initial=0.5))
    state = env.reset()
    assert (state["previous_action"] == 0.5).all()
    action = torch.tensor([[0.1, -0.2], [0.3, 0.4]])
    state = env.step(state.set("action", action))["next"]
    state["_reset"] = torch.tensor([[True], [False]])
    state = env.reset(state)
    torch.testing.assert_close(state["previous_action"], torch.tensor([[0.5, 0.5], [0.3, 0.4]]))


def test_a_network_sees_it_in_other_environments_and_in_workers() -> None:
    def make() -> TransformedEnv:
        seen = CatTensors(["observation", "previous_action"], "observation", del_keys=False)
        return TransformedEnv(GymEnv("Pendulum-v1"), Compose(PreviousAction(), seen))

    env = SerialEnv(2, make)
    steps = env.rollout(5)
    assert steps["observation"].shape == (2, 5, 4)
    torch.testing.assert_close(steps["observation"][:, 1:, 3:], steps["action"][:, :-1])


@pytest.mark.parametrize(
    ("initial", "message"),
    [
        (2.0, r"initial=\.\.\.\): expected an action inside the action bounds, given 2\.0"),
        (torch.zeros(3), r"initial=\.\.\.\): expected a number, or as many .* 2, given .*3"),
    ],
)
def test_a_bad_initial_action_is_refused_by_name(
    initial: float | torch.Tensor, message: str
) -> None:
    env = TransformedEnv(PointNavEnv([2]), PreviousAction(initial))
    with pytest.raises(ValueError, match=message):
        _ = env.observation_spec


def test_the_published_action_is_not_changed_with_the_one_given() -> None:
    env = TransformedEnv(PointNavEnv([2]), PreviousAction())
    action = torch.full((2, 2), 0.25)
    after = env.step(TensorDict({"action": action}, [2]))["next", "previous_action"]
    action.zero_()
    assert (after == 0.25).all()
