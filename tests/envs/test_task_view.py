"""An environment's task is found below transforms, in any kind of environment."""

from collections.abc import Callable, Iterator
from functools import partial

import gymnasium
import pytest
from gymnasium.envs.classic_control import PendulumEnv
from tensordict import TensorDict
from torchrl.envs import (
    Compose,
    EnvBase,
    GymEnv,
    GymWrapper,
    ParallelEnv,
    RewardSum,
    SerialEnv,
    StepCounter,
    TransformedEnv,
)

from cnfp_torchrl.configuration import compose_config
from cnfp_torchrl.envs.task_view import Map, Series, ShowTask, TaskView, find_task_view
from cnfp_torchrl.tasks.point_nav import PointNavEnv
from cnfp_torchrl.training.agent import build_environment


class Swing(TaskView):
    series = (Series("speed", "rad/s"),)


class OwnPendulum(PendulumEnv):
    def task_view(self, env: EnvBase) -> TaskView:
        return Swing()


def test_found_below_transforms() -> None:
    bare = PointNavEnv([2])
    env = TransformedEnv(
        TransformedEnv(bare, RewardSum()), Compose(StepCounter()), auto_unwrap=False
    )
    assert type(find_task_view(env)) is type(find_task_view(bare)) is not TaskView


def test_found_in_a_gymnasium_environment() -> None:
    wrapped = gymnasium.wrappers.TimeLimit(OwnPendulum(), 10)
    view = find_task_view(TransformedEnv(GymWrapper(wrapped), RewardSum()))
    assert isinstance(view, Swing)
    assert view.series[0].title == "Speed (rad/s)"


ENVIRONMENTS: dict[str, Callable[[], EnvBase]] = {
    "gymnasium": lambda: GymEnv("Pendulum-v1"),
    "serial": lambda: SerialEnv(2, lambda: PointNavEnv()),
    "serial, transformed": lambda: TransformedEnv(
        SerialEnv(2, lambda: GymEnv("Pendulum-v1")), RewardSum()
    ),
    "parallel": lambda: ParallelEnv(2, partial(GymEnv, "Pendulum-v1")),
}


@pytest.fixture(params=ENVIRONMENTS)
def env(request: pytest.FixtureRequest) -> Iterator[EnvBase]:
    made = ENVIRONMENTS[request.param]()
    yield made
    if not made.is_closed:
        made.close()


def test_environments_that_show_nothing_may_be_asked_before_any_reset(env: EnvBase) -> None:
    view = find_task_view(env)
    assert view.map is None
    assert not view.series


def test_any_environment_may_be_given_a_view(env: EnvBase) -> None:
    view = Swing()
    assert find_task_view(TransformedEnv(env, ShowTask(view), auto_unwrap=False)) is view


@pytest.mark.parametrize("given", [None, {"name": "x"}, Swing])
def test_what_is_no_view_is_refused(given: object) -> None:
    with pytest.raises(TypeError, match=r"env\.view: expected an instance of a class derived"):
        ShowTask(given)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("overrides", "found"),
    [
        ([], "PointNavView"),
        (["+env.view._target_=tests.envs.test_task_view.Swing"], "Swing"),
    ],
)
def test_a_configuration_s_view_takes_the_place_of_the_environment_s(
    overrides: list[str], found: str
) -> None:
    config = compose_config(*overrides)
    assert type(find_task_view(build_environment(config))).__name__ == found


def test_no_environment_shows_nothing() -> None:
    view, state = find_task_view(None), TensorDict({}, [])
    assert view.situation(state) is None
    assert not view.constraint_sentences(state)
    assert not view.series_values(state)
    assert view.goal(state) is None
    assert view.state_setter is None


class Lost(TaskView):
    map = Map((0.0, 1.0), (0.0, 1.0))


def test_a_map_without_a_position_is_explained() -> None:
    with pytest.raises(NotImplementedError, match="Lost has a map and needs `position`"):
        Lost().position(TensorDict({}, []))


def test_the_longer_side_scales_a_map() -> None:
    plane = Map((1.0, 5.0), (-1.0, 1.0))
    assert plane.center == (3.0, 0.0)
    assert plane.half_width == 2.0
