"""The audit on a disc of allowed actions, where every number it reports is known in closed form."""

import json
from functools import cache
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import CatTensors, EnvBase, ExcludeTransform, TransformedEnv

from cnfp_torchrl.audit import AuditReport, AuditSettings, ConstraintMetrics, Share, audit
from cnfp_torchrl.audit.states import uniform_states
from cnfp_torchrl.envs import (
    ConstraintAnchor,
    GeometryTransform,
    PreviousAction,
    constraint_bijectors,
)
from cnfp_torchrl.geometry import Ball, ConstraintSet, VisibleRegion
from cnfp_torchrl.visual.figures.audit import audit_figure

# The audit says itself what holds nowhere.
pytestmark = pytest.mark.filterwarnings("ignore::cnfp_torchrl.envs.RelaxedEverywhereWarning")

LOWEST = 0.5
SMALL = AuditSettings(states=128, actions=32, steps=3, seed=1)


class Disc(EnvBase):
    """Actions longer than the observed limit violate; a step draws another limit."""

    constraint_names = ("disc",)

    def __init__(self, batch: int = 64, *, cost: bool = True) -> None:
        super().__init__(batch_size=[batch])
        self.limit = torch.ones(batch, 1)
        entries = {"observation": Bounded(LOWEST, 1.0, (batch, 1))}
        if cost:
            entries["cost"] = Bounded(0.0, 1.0, (batch, 1))
        self.observation_spec = Composite(entries, shape=[batch])
        self.action_spec = Bounded(-1.0, 1.0, (batch, 2))
        self.reward_spec = Unbounded((batch, 1))

    def _shown(self, cost: Tensor) -> TensorDict:
        shown = {"observation": self.limit, "cost": cost, "done": torch.zeros_like(cost).bool()}
        return TensorDict(
            {k: v for k, v in shown.items() if k != "cost" or "cost" in self.observation_spec},
            self.batch_size,
        )

    def _reset(self, tensordict: Any = None, *, limit: Tensor | None = None) -> TensorDict:
        fresh = LOWEST + (1 - LOWEST) * torch.rand_like(self.limit)
        self.limit = fresh if limit is None else limit.clone()
        return self._shown(torch.zeros_like(self.limit))

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        length = tensordict["action"].norm(dim=-1, keepdim=True)
        cost = (length > self.limit).float()
        self._reset()
        return self._shown(cost).set("reward", cost)

    def _set_seed(self, seed: int | None) -> None:
        return


def set_state(env: EnvBase, states: TensorDictBase) -> TensorDictBase:
    return env.reset(limit=states["observation"])


def over(tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> Tensor:
    return tensordict["action"].norm(dim=-1) > tensordict["observation"][..., 0]


class Share_(GeometryTransform):
    """The concentric ball with a share of the limit; beyond the bounds for small limits."""

    def __init__(self, share: float, dropped_below: float = 0.0, name: str = "disc") -> None:
        super().__init__(name)
        self.share, self.dropped_below = share, dropped_below

    def constraint_set(self, tensordict: TensorDictBase) -> Ball:
        limit = tensordict["observation"]
        out = limit < self.dropped_below
        center = torch.where(out, 5.0, 0.0).expand(*limit.shape[:-1], 2)
        return Ball(center, self.share * limit[..., 0], validate_args=False)


def with_geometry(base: EnvBase, geometry: GeometryTransform) -> TransformedEnv:
    env = TransformedEnv(base, geometry)
    return env.append_transform(ConstraintAnchor(constraint_bijectors(env)))


def of(report: AuditReport, source: str, name: str = "disc") -> ConstraintMetrics:
    (found,) = (state for state in report.sources[source] if state.name == name)
    return found


@cache
def audited(share: float, dropped_below: float = 0.0) -> AuditReport:
    env = with_geometry(Disc(512), Share_(share, dropped_below))
    return audit(env, state_setter=set_state, settings=SMALL)


@pytest.mark.parametrize("share", [0.5, 0.8, 1.0])
@pytest.mark.parametrize("source", ["rollouts", "uniform"])
@pytest.mark.parametrize("name", ["disc", "together"])
def test_coverage_is_the_known_one(share: float, source: str, name: str) -> None:
    report = audited(share)
    found = of(report, source, name)
    assert report.flaws == []
    assert found.coverage is not None
    assert found.coverage.of > 1500
    assert found.coverage.low <= share**2 <= found.coverage.high
    assert found.coverage.high - found.coverage.low < 0.06
    assert found.gave_way.count == found.escaped.count == found.dead_ends.count == 0


def test_tightness_is_the_known_one() -> None:
    found = of(audited(0.8), "uniform")
    volume, slack = found.volume, found.slack
    assert None not in (*volume.values(), *slack.values())
    # A disc's share of the square, at limits between a half and one.
    assert volume["median"] == pytest.approx(torch.pi * 0.6**2 / 4, abs=0.07)
    assert slack["median"] == pytest.approx(0.6, abs=0.06)
    assert 0.8 * LOWEST <= slack["min"] < 0.42
    assert 0.78 < slack["max"] <= 0.8


def test_too_large_a_set_is_caught_with_its_state() -> None:
    report = audited(1.05)
    assert any("uniform" in flaw and "violate" in flaw for flaw in report.flaws)
    for source in ("rollouts", "uniform"):
        found = of(report, source)
        assert found.unsound is not None
        assert found.unsound.count > 0
        assert found.escaped.count == 0
        assert len(found.examples["unsound"]) == SMALL.examples
        for example in found.examples["unsound"]:
            (limit,) = example["state"]["observation"]
            length = torch.tensor(example["action"]).norm()
            assert limit < length <= 1.05 * limit
            assert example["violates"] == ["disc"]
            assert example["sets"]["disc"]["radius"] == pytest.approx(1.05 * limit)
            assert example["sets"]["disc"]["active"]
    assert report.executed.led_into["disc"] == report.executed.violations["disc"] > 0
    (example, *_) = report.executed.examples["disc"]
    assert torch.tensor(example["action"]).norm() > example["state"]["observation"][0]
    text = str(report)
    assert "FLAW: disc, uniform" in text
    assert f"{report.flaws[0].split(': ')[1].split(' actions')[0]}" in text


def test_relaxed_states_are_counted() -> None:
    below = 0.7
    found = of(audited(0.9, below), "uniform")
    assert found.relaxed.of == SMALL.states
    assert found.relaxed.low < (below - LOWEST) / (1 - LOWEST) < found.relaxed.high
    assert found.gave_way == found.relaxed
    assert found.dropped.count == 0
    # From the corner of the bounds to discs about (5, 5), with radii of 0.9 of 0.5 to 0.7.
    nearest = 4 * 2**0.5
    amounts = found.relaxation
    assert None not in amounts.values()
    assert nearest - 0.9 * below < amounts["min"] < amounts["median"] < amounts["max"]
    assert amounts["max"] < nearest - 0.9 * LOWEST + 0.02
    assert found.possible is not None
    assert found.possible.count == found.possible.of == found.relaxed.count
    for example in found.examples["gave_way"]:
        assert example["sets"]["disc"]["relaxation"] > 4
        assert example["state"]["observation"][0] < below
        assert not example["sets"]["disc"]["active"]
    # What is not active is not held against the set, and its volume is not counted.
    assert found.unsound is not None
    assert found.unsound.count == 0
    assert found.volume["min"] is not None
    assert found.volume["min"] > 0.2


def test_a_set_that_never_holds_is_a_flaw() -> None:
    """It is not unsound, and all violations happen while it is dropped."""
    report = audited(0.8, 2.0)
    (flaw,) = report.flaws
    states = sum(of(report, source).relaxed.of for source in ("rollouts", "uniform"))
    assert flaw.startswith(f"disc: holds in none of {states} states, relaxed in {states}, by 4.")
    assert flaw.endswith(f"its indicator allows an action in {states} of them")
    assert not any("holds in none" in flaw for flaw in audited(0.8, 0.7).flaws)
    executed = report.executed.violations_while["disc"]
    assert executed == {"active": 0, "relaxed": report.executed.violations["disc"], "dropped": 0}


class Impossible(Share_):
    """What no action keeps, whatever the indicator says."""

    def constraint_set(self, tensordict: TensorDictBase) -> ConstraintSet:
        limit = tensordict["observation"]
        if self.share:
            return Ball(torch.full((*limit.shape[:-1], 2), 5.0), limit[..., 0])
        hidden = torch.tensor([[-0.1, -0.1], [0.1, 0.1]]).expand(*limit.shape[:-1], 1, 2, 2)
        return VisibleRegion(torch.zeros_like(hidden[..., 0, 0, :]), hidden, 1 + limit[..., 0])


@pytest.mark.parametrize(("share", "how"), [(1, "relaxed in"), (0, "dropped in")])
def test_a_constraint_that_holds_nowhere_is_a_flaw_also_where_nothing_keeps_it(
    share: float, how: str
) -> None:
    env = with_geometry(Disc(64), Impossible(share))
    never = {"disc": lambda before, after: torch.ones(64, dtype=torch.bool)}
    settings = AuditSettings(states=32, actions=8, steps=2)
    report = audit(env, state_setter=set_state, indicators=never, settings=settings)
    (flaw,) = report.flaws
    assert how in flaw
    assert flaw.endswith("in 0 of them")
    text = str(report)
    assert max(map(len, text.splitlines())) <= 100
    found = of(report, "uniform")
    assert (found.relaxed.share, found.dropped.share) == ((1, 0) if share else (0, 1))
    # Relaxed, the flow keeps the wider set: nothing escaped.
    assert found.escaped.count == 0


def test_a_point_is_no_flaw_though_it_is_always_relaxed() -> None:
    """A set without interior gives way by its depth and the leeway, and holds as well as it can."""
    env = with_geometry(Disc(64), Share_(0.0))
    settings = AuditSettings(states=32, actions=8, steps=2)
    report = audit(env, state_setter=set_state, settings=settings)
    found = of(report, "uniform")
    assert found.relaxed.share == found.had.share == 1
    assert report.flaws == []


def test_too_narrow_a_set_whose_actions_violate_is_a_flaw() -> None:
    """Never active, it is judged by what was executed: such as a budget in another unit."""

    class Aside(GeometryTransform):
        def constraint_set(self, tensordict: TensorDictBase) -> Ball:
            limit = tensordict["observation"][..., 0]
            center = torch.tensor([0.99, 0.99]).expand(*limit.shape, 2)
            return Ball(center, torch.zeros_like(limit), validate_args=False)

    env = with_geometry(Disc(64), Aside("disc"))
    settings = AuditSettings(states=32, actions=8, steps=2)
    report = audit(env, state_setter=set_state, settings=settings)
    assert of(report, "uniform").had.share == 1
    (flaw,) = report.flaws
    assert flaw.startswith("disc: too narrow a set in all states")
    assert "128 of 128 executed steps" in flaw


def test_a_flow_that_leaves_the_wider_set_is_a_flaw() -> None:
    env = with_geometry(Disc(64), Impossible(1.0))
    settings = AuditSettings(states=32, actions=8, steps=2)
    report = audit(env, flow="unconstrained", state_setter=set_state, settings=settings)
    assert of(report, "uniform").escaped.count > 0
    assert any("lie outside the set" in flaw for flaw in report.flaws)


def test_dead_ends_are_flaws_where_that_is_asked_for() -> None:
    env = with_geometry(Disc(256), Share_(0.9, 0.7))
    indicators = {"disc": lambda before, after: torch.zeros(256, dtype=torch.bool)}
    for strict in (False, True):
        settings = AuditSettings(states=32, actions=8, steps=2, strict=strict, uniform=False)
        report = audit(env, state_setter=set_state, indicators=indicators, settings=settings)
        found = of(report, "rollouts")
        # Every step draws another limit, so that 2 in 5 actions lead to where it is dropped.
        assert found.dead_ends.low < 0.4 < found.dead_ends.high
        assert bool(report.flaws) == strict


def test_judged_by_copies() -> None:
    env = with_geometry(Disc(8), Share_(0.8))
    settings = AuditSettings(states=24, actions=16, steps=10)
    report = audit(env, settings=settings)
    assert list(report.sources) == ["rollouts"]
    assert "rollouts only" in report.notes[0]
    found = of(report, "rollouts")
    assert found.gave_way.of == 24
    assert found.coverage is not None
    assert found.coverage.low <= 0.64 <= found.coverage.high
    assert report.flaws == []


class Fresh(Disc):
    """Copies start afresh, as those of some simulators do."""

    def __deepcopy__(self, memo: Any) -> "Fresh":
        return Fresh(self.batch_size[0])


class Uncopied(Disc):
    def __deepcopy__(self, memo: Any) -> "Uncopied":
        raise RuntimeError("there is but one simulator")


class Walk(Disc):
    """The limit moves a little with each step."""

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        limit = self.limit
        outcome = super()._step(tensordict)
        self.limit = (limit - 0.01).clamp(min=LOWEST)
        return outcome.set("observation", self.limit)


class FreshWalk(Walk, Fresh):
    pass


@pytest.mark.parametrize(
    ("base", "message"),
    [(FreshWalk, "steps to another 'observation'"), (Uncopied, r"but one.*state_setter")],
)
def test_environments_that_cannot_be_copied_are_refused(base: type[Disc], message: str) -> None:
    env = with_geometry(base(4), Share_(0.8))
    with pytest.raises(TypeError, match=message):
        audit(env, settings=AuditSettings(states=4, actions=4, steps=3))


def test_a_state_setter_of_the_bare_environment_and_its_observation_is_enough() -> None:
    def set_bare_state(env: EnvBase, states: TensorDictBase) -> TensorDictBase:
        assert type(env) is FreshWalk
        env.limit = states["observation"].clone()
        return TensorDict({"observation": env.limit}, env.batch_size)

    env = with_geometry(FreshWalk(64), Share_(1.05))
    report = audit(env, state_setter=set_bare_state, settings=SMALL)
    assert list(report.sources) == ["rollouts", "uniform"]
    assert any(flaw.startswith("disc, uniform") for flaw in report.flaws)


@pytest.mark.parametrize("out_key", ["observation", "seen"])
def test_a_state_setter_is_given_what_was_observed_before_it_was_concatenated(out_key: str) -> None:
    class OfVector(Share_):
        def constraint_set(self, tensordict: TensorDictBase) -> Ball:
            limit = tensordict[out_key][..., :1]
            return Ball(limit.new_zeros(*limit.shape[:-1], 2), self.share * limit[..., 0])

    env = TransformedEnv(Disc(64), PreviousAction())
    parts = ["observation", "previous_action"]
    concatenated = CatTensors(parts, out_key, del_keys=out_key == "seen", sort=False)
    env.append_transform(concatenated)
    geometry = OfVector(0.8)
    geometry.in_keys = [out_key]
    env.append_transform(geometry)
    env.append_transform(ConstraintAnchor(constraint_bijectors(env)))

    def set_limit(env: EnvBase, states: TensorDictBase) -> TensorDictBase:
        assert states["observation"].shape == (64, 1)
        return env.reset(limit=states["observation"])

    report = audit(env, state_setter=set_limit, settings=SMALL)
    assert list(report.sources) == ["rollouts", "uniform"]
    assert not report.flaws


def test_entries_that_a_transform_removes_need_not_be_set() -> None:
    class Counted(Disc):
        def __init__(self, batch: int) -> None:
            super().__init__(batch)
            self.observation_spec["count"] = Unbounded((batch, 1))
            self.count = 0

        def _shown(self, cost: Tensor) -> TensorDict:
            self.count += 1
            return super()._shown(cost).set("count", torch.full_like(cost, self.count))

    env = with_geometry(Counted(64), Share_(0.8)).append_transform(ExcludeTransform("count"))
    assert not audit(env, state_setter=set_state, settings=SMALL).flaws


def test_a_state_setter_that_misses_is_refused() -> None:
    env = with_geometry(Disc(4), Share_(0.8))
    with pytest.raises(ValueError, match="shows another 'observation'"):
        audit(
            env,
            state_setter=lambda env, states: env.reset(),
            settings=AuditSettings(states=4, steps=1),
        )


def test_own_indicators_judge() -> None:
    env = with_geometry(Disc(256, cost=False), Share_(1.05))
    settings = AuditSettings(states=32, actions=32, steps=5)
    report = audit(
        env, state_setter=set_state, indicators={"disc": over, "other": over}, settings=settings
    )
    unsound = of(report, "uniform").unsound
    assert unsound is not None
    assert unsound.count > 0
    assert any("other" in note for note in report.notes)
    with pytest.raises(ValueError, match="expected one for at least one of the constraints"):
        audit(env, state_setter=set_state, indicators={"other": over}, settings=settings)
    with pytest.raises(ValueError, match=r"'disc': expected a judge of the same name.*'disk'"):
        audit(env, state_setter=set_state, indicators={"disk": over}, settings=settings)


def test_a_constraint_without_indicator_is_not_judged() -> None:
    env = TransformedEnv(Disc(256), Share_(0.8))
    env.append_transform(Share_(0.9, name="second"))
    env.append_transform(ConstraintAnchor(constraint_bijectors(env)))
    report = audit(
        env, state_setter=set_state, settings=AuditSettings(states=16, actions=16, steps=5)
    )
    found = of(report, "uniform", "second")
    assert found.unsound is found.coverage is found.possible is None
    assert found.volume["median"] is not None
    assert any(note.startswith("second: no indicator") for note in report.notes)
    assert str(report).endswith("no flaw found; second: not judged")
    assert audit_figure(report)


def test_wrong_environments_are_explained() -> None:
    with pytest.raises(ValueError, match="at least one constraint, given Disc"):
        audit(Disc(4))
    with pytest.raises(ValueError, match=r"key 'cost': expected \(4, 1\).*given none"):
        audit(with_geometry(Disc(4, cost=False), Share_(0.8)))
    with pytest.raises(KeyError, match="ConstraintAnchor"):
        audit(TransformedEnv(Disc(4), Share_(0.8)), settings=AuditSettings(steps=1))


@pytest.mark.parametrize("name", ["states", "actions", "steps"])
def test_nothing_to_try_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match=rf"audit.{name}: expected a whole number >= 1, given 0"):
        AuditSettings(**{name: 0})


def test_json_holds_the_whole_report() -> None:
    document = audited(1.05).as_dict()
    assert json.loads(json.dumps(document, allow_nan=False)) == document
    assert document["sources"]["uniform"]["disc"]["unsound"]["count"] > 0
    assert document["flaws"]


def test_the_same_seed_finds_the_same() -> None:
    settings = AuditSettings(states=10, actions=8, steps=5)
    first, second = (
        audit(
            with_geometry(Disc(4), Share_(1.05)), state_setter=set_state, settings=settings
        ).as_dict()
        for _ in range(2)
    )
    assert first == second


def test_intervals_hold_for_actions_that_come_in_states() -> None:
    missed = 0
    for _ in range(300):
        # A state's own share differs from the next one's; 0.5 on average.
        own = torch.rand(60, 1)
        hits = (torch.rand(60, 40) < own).sum(-1)
        share = Share.clustered(hits, torch.full((60,), 40))
        missed += not share.low <= 0.5 <= share.high
    assert missed < 0.1 * 300


def test_intervals_at_the_ends() -> None:
    none = Share.clustered(torch.zeros(5), torch.zeros(5))
    assert (none.share, none.low, none.high) == (None, 0, 1)
    zero = Share.clustered(torch.zeros(50), torch.full((50,), 100))
    assert zero.share == zero.low == 0
    assert 1 / 50 < zero.high < 4 / 50
    one = Share.clustered(torch.tensor([3]), torch.tensor([4]))
    assert one.low < 0.75 < one.high
    assert one.high - one.low > 0.5


def test_states_are_numbers_whatever_ends_the_spec_has() -> None:
    class Partly(Disc):
        """Ends on both sides, on either one, on none, and the largest numbers for none."""

        def __init__(self) -> None:
            super().__init__(64, cost=False)
            largest = torch.finfo().max
            low = torch.tensor([-2.0, -torch.inf, 1.0, -torch.inf, -largest])
            high = torch.tensor([2.0, -1.0, torch.inf, torch.inf, largest])
            spec = Bounded(low.expand(64, 5), high.expand(64, 5), (64, 5))
            self.observation_spec = Composite({"observation": spec}, shape=[64])

    drawn = uniform_states(Partly(), lambda _, states: states, 512)["observation"]
    assert drawn.isfinite().all()
    assert drawn[:, 0].abs().max() <= 2
    assert drawn[:, 0].std() > 1
    assert drawn[:, 1].max() <= -1
    assert drawn[:, 2].min() >= 1
    assert drawn[:, 3:].abs().max() < 10


@pytest.mark.parametrize("flow", ["exact", "radial", "projection", "squash", "unconstrained"])
def test_every_flow_is_audited(flow: str) -> None:
    env = with_geometry(Disc(64), Share_(0.8))
    settings = AuditSettings(states=16, actions=8, steps=2)
    report = audit(env, flow=flow, state_setter=set_state, settings=settings)
    assert bool(report.flaws) == (flow == "unconstrained")
    titles = [axes.get_title() for axes in audit_figure(report).axes]
    assert any("escaped" in title for title in titles) == (flow == "unconstrained")
