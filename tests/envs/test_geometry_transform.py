"""The base of geometry transforms, through constraints that a user might write."""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import EnvBase, TransformedEnv, check_env_specs

from cnfp_torchrl.envs import GeometryTransform, constrain_env
from cnfp_torchrl.geometry import (
    Ball,
    Box,
    ConstraintSet,
    Ellipsoid,
    GeometryError,
    HalfSpaces,
    TaskSpaceBall,
    are_within,
)
from cnfp_torchrl.tasks.point_nav import BatteryGeometry, ObstacleGeometry, PointNavEnv
from tests.host_reads import HostReads
from tests.walls import Told

STATES = 64


class SpeedLimit(GeometryTransform):
    """The example of the base class's docstring, near enough."""

    def constraint_set(self, tensordict: TensorDictBase) -> Ball:
        goal = tensordict["observation"][..., 3:]
        return Ball(0.1 * goal, torch.ones_like(goal[..., 0]), validate_args=False)


class Motor(GeometryTransform):
    """The same limits in every state, without a batch."""

    def constraint_set(self, tensordict: TensorDictBase) -> Box:
        return Box(torch.tensor([-1.0, -0.5]), torch.tensor([1.0, 0.5]))


class Wind(GeometryTransform):
    """Of a family with a matrix, and with a safe action."""

    def constraint_set(self, tensordict: TensorDictBase) -> Ellipsoid:
        scale = torch.eye(2).expand(*tensordict.batch_size, 2, 2)
        return Ellipsoid(tensordict["observation"][..., :2], scale, validate_args=False)

    def safe_action(self, tensordict: TensorDictBase, allowed: ConstraintSet) -> torch.Tensor:
        return allowed.fields()["center"]


class Broken(GeometryTransform):
    """Publishes whatever it is told."""

    def __init__(self, value: Ball) -> None:
        super().__init__("broken")
        self.value = value

    def constraint_set(self, tensordict: TensorDictBase) -> Ball:
        return self.value


def env_with(*transforms: GeometryTransform, batch_size: tuple[int, ...] = (3,)) -> EnvBase:
    env: EnvBase = TransformedEnv(PointNavEnv(batch_size, seed=0))
    for transform in transforms:
        env.append_transform(transform)
    return env


@pytest.mark.parametrize("batch_size", [(), (1,), (2, 3)])
@pytest.mark.parametrize("transform", [SpeedLimit, Motor, Wind])
def test_a_new_constraint_is_one_method(
    transform: type[GeometryTransform], batch_size: tuple[int, ...]
) -> None:
    env = env_with(transform("mine"), batch_size=batch_size)
    check_env_specs(env)
    state = env.reset()
    fields = transform("mine").constraint_set(state).fields()
    assert set(state["constraints", "mine"].keys()) == set(fields)
    for name, value in fields.items():
        assert torch.equal(
            state["constraints", "mine", name], value.expand_as(state["constraints", "mine", name])
        )
        assert state["constraints", "mine", name].shape[: len(batch_size)] == batch_size
    assert (("constraints", "safe_action") in state.keys(True)) == (transform is Wind)


def test_sets_stand_beside_each_other_and_belong_to_their_state() -> None:
    env = env_with(ObstacleGeometry(), BatteryGeometry(), SpeedLimit("speed"))
    rollout = env.rollout(5)
    for data in (rollout, rollout["next"]):
        again = SpeedLimit("speed")(data.select("observation"))
        # Computed anew for all steps at once: up to rounding.
        torch.testing.assert_close(
            data["constraints", "speed", "center"], again["constraints", "speed", "center"]
        )
    assert set(rollout["constraints"].keys()) == {"obstacle", "battery", "speed"}


def test_a_replay_buffer_computes_instead_of_storing() -> None:
    geometries = [ObstacleGeometry(), BatteryGeometry()]
    rollout = env_with(*geometries, batch_size=()).rollout(20)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(20), batch_size=20)
    buffer.extend(rollout.exclude("constraints", ("next", "constraints")))
    for geometry in (ObstacleGeometry(), BatteryGeometry()):
        buffer.append_transform(geometry)
    sample = buffer.sample()
    order = sample["index"]
    for key in rollout["constraints"].keys(True, True):
        key = (key,) if isinstance(key, str) else key
        for prefix in ((), ("next",)):
            path = (*prefix, "constraints", *key)
            torch.testing.assert_close(sample[path], rollout[path][order])


@pytest.mark.parametrize("transform", [ObstacleGeometry, BatteryGeometry])
@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_an_observation_must_be_finite(transform: type[GeometryTransform], bad: float) -> None:
    state = env_with().reset()
    state["observation"][2, 3] = bad
    message = rf"key 'observation' at index \[2, 3\]: expected a finite number, given {bad}"
    with pytest.raises(GeometryError, match=message):
        transform()(state)


def test_an_observation_must_have_its_five_numbers() -> None:
    state = TensorDict({"observation": torch.zeros(3, 4)}, batch_size=3)
    with pytest.raises(
        GeometryError, match=r"'observation': expected .*\(\*batch, 5\), given shape \(3, 4\)"
    ):
        BatteryGeometry()(state)


def test_a_set_must_be_one() -> None:
    center, radius = torch.zeros(3, 2), torch.ones(3)
    for bad, message in (
        (
            Ball(center, -radius, validate_args=False),
            r"'broken' .*'radius' at index \[0\].*radius >= 0",
        ),
        (
            Ball(center / 0, radius, validate_args=False),
            r"'broken' .*'center' at index \[0, 0\].*a number",
        ),
        (
            Ball(center, torch.ones(2), validate_args=False),
            "'broken' .*batch shapes that broadcast",
        ),
        (
            Ball(torch.zeros(4, 2), torch.ones(4)),
            r"'broken', field 'center': .*broadcasts to \(3,\)",
        ),
    ):
        with pytest.raises(GeometryError, match=message):
            Broken(bad)(TensorDict({"observation": torch.zeros(3, 5)}, batch_size=3))


@pytest.mark.parametrize("name", ["", "anchor", "safe_action", 3])
def test_a_constraint_needs_a_name_of_its_own(name: object) -> None:
    with pytest.raises(ValueError, match="name: expected"):
        SpeedLimit(name)  # type: ignore[arg-type]


def test_names_and_keys_must_fit_the_environment() -> None:
    with pytest.raises(ValueError, match="'same': expected to be the only one to publish"):
        _ = env_with(SpeedLimit("same"), SpeedLimit("same")).observation_spec
    with pytest.raises(KeyError, match=r"'far': expected to read \['lidar'\], given .*observation"):
        _ = env_with(SpeedLimit("far", in_keys=["lidar"])).observation_spec
    with pytest.raises(TypeError, match=r"write in_keys=\['observation'\]"):
        SpeedLimit("mine", in_keys="observation")


# A user's mistakes --------------------------------------------------------------------------------


def raise_(error: Exception) -> None:
    raise error


@pytest.mark.parametrize("given", [None, torch.zeros(3, 2), Ball], ids=["None", "tensor", "class"])
def test_what_is_no_set_is_refused_by_name(given: object) -> None:
    message = r"'told', Told.constraint_set: expected it to return a ConstraintSet .*given "
    with pytest.raises(TypeError, match=message + type(given).__name__):
        constrain_env(PointNavEnv([3]), Told(lambda _: given))


@pytest.mark.parametrize("error", [KeyError("lidar"), RuntimeError("odd"), ValueError("odd")])
def test_errors_of_a_constraints_own_code_name_it(error: Exception) -> None:
    with pytest.raises(type(error)) as caught:
        constrain_env(PointNavEnv([3]), Told(lambda _: raise_(error)))
    assert caught.value is error
    by_whom, when = error.__notes__
    assert by_whom == "raised by constraint 'told', Told.constraint_set"
    assert "zero of the observation spec" in when


class Undeclared(GeometryTransform):
    """Reads an entry that its `in_keys` do not name, in one of its methods."""

    def constraint_set(self, tensordict: TensorDictBase) -> Ball:
        if self.name == "set":
            tensordict["cost"]
        return Ball(torch.zeros(2), torch.tensor(1.0), validate_args=False)

    def safe_action(self, tensordict: TensorDictBase, allowed: ConstraintSet) -> Tensor:
        return 0 * tensordict["cost" if self.name == "action" else "observation"][..., :2]


@pytest.mark.parametrize("name", ["set", "action"])
def test_what_is_read_must_be_declared(name: str) -> None:
    """Policies without an environment, exports and replay buffers have these entries alone."""
    message = rf"'{name}': expected Undeclared to read .* its in_keys, \['observation'\].*cost"
    with pytest.raises(GeometryError, match=message):
        constrain_env(PointNavEnv([3]), Undeclared(name))
    constrain_env(PointNavEnv([3]), Undeclared(name, ["observation", "cost"]))


def test_keys_may_be_a_configurations_lists() -> None:
    assert SpeedLimit("slow", [["arm", "speed"], "observation"]).in_keys == [  # type: ignore[list-item]
        ("arm", "speed"),
        "observation",
    ]


def one_half_space_a_state(state: TensorDictBase) -> HalfSpaces:
    like = state["observation"][..., :2]
    return HalfSpaces(like, torch.ones_like(like[..., 0]), validate_args=False)


def one_jacobian_a_state(state: TensorDictBase) -> TaskSpaceBall:
    like = state["observation"][..., :2]
    one = torch.ones_like(like[..., 0])
    return TaskSpaceBall(like, one, one, validate_args=False)


@pytest.mark.parametrize("batch", [(), (1,), (2,), (3,), (2, 2)])
@pytest.mark.parametrize(
    ("publish", "field"),
    [(one_half_space_a_state, "normals"), (one_jacobian_a_state, "jacobian")],
)
def test_a_batch_in_the_place_of_rows_is_refused(
    batch: tuple[int, ...], publish: Callable[..., ConstraintSet], field: str
) -> None:
    message = f"'told', field '{field}': expected one shape" if batch else "'told'"
    with pytest.raises(GeometryError, match=message):
        constrain_env(PointNavEnv(batch), Told(publish))


def test_one_set_for_all_states_is_none_that_follows_the_batch() -> None:
    env = constrain_env(
        PointNavEnv([2]), Told(lambda _: HalfSpaces(torch.ones(2, 2), torch.ones(2)))
    )
    assert env.reset()["constraints", "told", "normals"].shape == (2, 2, 2)


def test_an_attribute_error_is_not_taken_for_a_missing_spec() -> None:
    message = "'told', Told.constraint_set: AttributeError: .*no attribute 'observation'"
    with pytest.raises(GeometryError, match=message) as caught:
        constrain_env(PointNavEnv([3]), Told(lambda state: state.observation))
    assert isinstance(caught.value.__cause__, AttributeError)


def test_a_field_that_is_no_tensor_is_named() -> None:
    env_of = Told(lambda state: Ball(state["observation"][..., :2], 0.5, validate_args=False))
    with pytest.raises(GeometryError, match=r"'told' .*'radius': expected a .*tensor, given float"):
        constrain_env(PointNavEnv([3]), env_of)


def test_the_family_stays_the_same() -> None:
    def undecided(state: TensorDictBase) -> ConstraintSet:
        like = state["observation"][..., :2]
        if (like == 0).all():
            return Box(like - 1, like + 1)
        return Ball(like, torch.ones_like(like[..., 0]))

    env = constrain_env(PointNavEnv([3]), Told(undecided))
    with pytest.raises(GeometryError, match=r"'told' .*expected a Box, .*before, given a Ball;"):
        env.reset()


@dataclass(frozen=True, eq=False)
class Mine(Ball):
    """A family of a user, with a slack of one's choice."""

    def slack(self, action: torch.Tensor) -> torch.Tensor:
        raise NotImplementedError


def mine(state: TensorDictBase) -> Mine:
    like = state["observation"][..., :2]
    return Mine(like, torch.ones_like(like[..., 0]), validate_args=False)


@pytest.mark.parametrize(
    ("slack", "given"),
    [
        (lambda action: action, r"\(3, 2\)"),
        (lambda action: action.sum(-1, keepdim=True), r"\(3, 1\)"),
        (lambda action: action.sum(), r"\(\)"),
        (lambda action: None, "NoneType"),
    ],
)
def test_a_slack_has_the_batchs_shape(
    monkeypatch: pytest.MonkeyPatch, slack: Callable[[torch.Tensor], Any], given: str
) -> None:
    monkeypatch.setattr(Mine, "slack", lambda self, action: slack(action))
    message = r"'told', .*Mine.slack: for actions \(3, 2\) expected .*shape \(3,\), given "
    with pytest.raises(GeometryError, match=message + given):
        constrain_env(PointNavEnv([3]), Told(mine))


@pytest.mark.parametrize(
    "event_dims", [{}, {"center": 1}, {"center": 1, "raduis": 0}, {"center": 0, "radius": 0}]
)
def test_a_familys_event_dims_name_its_fields(
    monkeypatch: pytest.MonkeyPatch, event_dims: dict[str, int]
) -> None:
    monkeypatch.setattr(Mine, "event_dims", event_dims)
    message = r"'told' \(Mine\): expected event_dims .*\['center', 'radius'\], .*given "
    with pytest.raises(GeometryError, match=message + re.escape(str(event_dims))):
        constrain_env(PointNavEnv([3]), Told(mine))


def test_a_family_must_state_its_event_dims() -> None:
    @dataclass(frozen=True, eq=False)
    class Stateless(Ball):
        event_dims: ClassVar[Mapping[str, int]] = {}

    with pytest.raises(GeometryError, match=r"Stateless\)?: expected event_dims"):
        constrain_env(PointNavEnv([3]), Told(lambda _: Stateless(torch.zeros(2), torch.ones(()))))


@pytest.mark.parametrize(
    ("answer", "given"),
    [(torch.zeros(3, 1), r"\(3, 1\)"), ([0.0, 0.0], "list")],
)
def test_a_safe_action_is_one_for_each_state(answer: object, given: str) -> None:
    class Unsafe(SpeedLimit):
        def safe_action(self, tensordict: TensorDictBase, allowed: ConstraintSet) -> Any:
            return answer

    message = r"'unsafe', Unsafe.safe_action: expected None or a tensor of shape \(3, 2\), given "
    with pytest.raises(GeometryError, match=message + given):
        constrain_env(PointNavEnv([3]), Unsafe("unsafe"))


class FirstStatesLimit(GeometryTransform):
    """Takes the first state's entry for all: an index where an ellipsis was meant."""

    def constraint_set(self, tensordict: TensorDictBase) -> Ball:
        goal = tensordict["observation"].reshape(-1, 5)[0, 3:]
        return Ball(0.1 * goal, torch.ones(()), validate_args=False)


class MeanLimit(GeometryTransform):
    """Depends on all states of the batch."""

    def constraint_set(self, tensordict: TensorDictBase) -> Ball:
        goal = tensordict["observation"][..., 3:]
        center = goal - goal.reshape(-1, 2).mean(0)
        return Ball(center, torch.ones_like(goal[..., 0]), validate_args=False)


@pytest.mark.parametrize("geometry", [FirstStatesLimit, MeanLimit])
@pytest.mark.parametrize("batch", [(2,), (3, 4)])
def test_a_set_is_that_of_its_own_state(
    geometry: type[GeometryTransform], batch: tuple[int, ...]
) -> None:
    env = constrain_env(PointNavEnv(batch), geometry("speed"))
    with pytest.raises(GeometryError, match=r"'speed', field 'center'.*state alone"):
        env.reset()


# What a step checks -------------------------------------------------------------------------------


def test_a_step_reads_its_checks_on_the_host_once() -> None:
    plain = PointNavEnv([STATES], seed=0)
    env = constrain_env(PointNavEnv([STATES], seed=0), ObstacleGeometry(), BatteryGeometry())
    counts = []
    for built in (plain, env):
        state = built.reset()
        state["action"] = torch.zeros(STATES, 2)
        state = built.step_mdp(built.step(state))
        state["action"] = torch.zeros(STATES, 2)
        with HostReads() as reads:
            built.step(state)
        counts.append(reads.count)
    assert counts[1] - counts[0] == 1


class Late(GeometryTransform):
    """Is right in the beginning, and then not."""

    def constraint_set(self, tensordict: TensorDictBase) -> Ball:
        x = tensordict["observation"]
        radius = torch.where(x[..., 0] == 0.5, -1.0, 1.0)
        return Ball(torch.zeros_like(x[..., :2]), radius, validate_args=False)


@pytest.mark.parametrize("with_anchor", [True, False])
def test_what_is_no_set_is_refused_in_the_step_that_leads_to_it(with_anchor: bool) -> None:
    env = constrain_env(PointNavEnv([3]), Late("late"), with_anchor=with_anchor)
    where = torch.tensor([[0.6, 0.6], [0.4, 0.6], [0.7, 0.6]])
    state = env.reset(position=where)
    action = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 0.0]])
    message = r"'late' \(Ball\), field 'radius' at index \[1\]: expected a finite radius >= 0"
    with pytest.raises(GeometryError, match=message):
        env.step(state.set("action", action))
    # The error leaves nothing behind.
    env.step(env.reset(position=where).set("action", torch.zeros(3, 2)))


def test_checks_can_be_left_out() -> None:
    env = constrain_env(PointNavEnv([3]), Late("late"), with_anchor=False, validate=False)
    state = env.reset(position=torch.tensor([0.5, 0.6]))
    assert float(state["constraints", "late", "radius"].max()) == -1


def test_a_geometry_that_the_anchor_checked_checks_again_where_it_is_alone() -> None:
    env = constrain_env(PointNavEnv([3]), Late("late"))
    env.reset()
    bad = TensorDict({"observation": torch.full((3, 5), 0.5)}, batch_size=3)
    for alone in (env.transform[0], env.transform[0].clone()):
        with pytest.raises(GeometryError, match="radius"):
            alone(bad.clone())


FAMILIES: list[tuple[ConstraintSet, str]] = [
    (Ball(torch.zeros(4, 2), torch.ones(4)), "radius"),
    (Box(-torch.ones(4, 2), torch.ones(4, 2)), "low"),
    (HalfSpaces(torch.ones(4, 1, 2), torch.ones(4, 1)), "normals"),
    (TaskSpaceBall(torch.ones(4, 1, 2), torch.ones(4, 1), torch.ones(4)), "offset"),
]


def is_sound(sets: ConstraintSet) -> bool:
    found = sets.evidence()
    return are_within(
        [evidence.value.item() for evidence in found], [evidence.limit for evidence in found]
    )


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf"), 1e35, -1.0, 3.0])
@pytest.mark.parametrize(("good", "field"), FAMILIES)
def test_the_check_on_the_device_agrees_with_the_one_that_explains(
    good: ConstraintSet, field: str, bad: float
) -> None:
    assert is_sound(good)
    fields = {name: value.clone() for name, value in good.fields().items()}
    fields[field].view(4, -1)[2, 0] = bad
    changed = type(good)(**fields, validate_args=False)
    try:
        changed.validate()
    except GeometryError:
        assert not is_sound(changed)
    else:
        assert is_sound(changed)
