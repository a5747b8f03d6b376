"""The audit of the geometry that an environment publishes against the environment's own indicators.

Two things are asked in many states. *Soundness*: does an indicator call any action a violation that
the geometry allows? *Coverage*: which share of the actions that the indicators allow lies in the
geometry's sets?

The indicators judge one step. A set may be smaller than what one step allows because it plans
ahead: a battery must last to the next station. That lowers the coverage and is no flaw; it is what
keeps the policy from *dead ends*, states in which the constraint has to be dropped. Whether it
succeeds is seen in two ways: by the allowed actions that lead to a dead end, and by violations in
rollouts after a state in which the constraint held.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import torch
from torchrl.envs import EnvBase
from torchrl.modules import SafeProbabilisticTensorDictSequential

from cnfp_torchrl.audit.measures import executed, findings, worst_scene
from cnfp_torchrl.audit.probes import CopiedProbe, PlacedProbe, Probe, Reader
from cnfp_torchrl.audit.report import AuditReport
from cnfp_torchrl.audit.rollouts import roll_out
from cnfp_torchrl.audit.states import (
    Place,
    bare,
    known_place,
    state_keys,
    uniform_states,
)
from cnfp_torchrl.audit.trial import run_trial
from cnfp_torchrl.envs import Indicator, constraint_bijectors
from cnfp_torchrl.modules import (
    ConstrainedFlowModule,
    ConstraintBijector,
    Flow,
    flow_head,
)
from cnfp_torchrl.training.settings import COUNT, FLAG, WHOLE

_EXPECTED = {
    "states": COUNT,
    "actions": COUNT,
    "steps": COUNT,
    "uniform": FLAG,
    "examples": WHOLE,
    "strict": FLAG,
    "seed": WHOLE,
}


@dataclass(frozen=True)
class AuditSettings:
    """How much is tried.

    Args:
        states: from each source.
        actions: through the flow, and as many uniform ones, in each state.
        steps: of the rollouts that states are taken from; more where copies need them.
        uniform: also look at states drawn uniformly, where the environment can be put into them.
        examples: of each kind of finding that are kept.
        strict: dead ends are flaws, too: for geometry that promises never to be dropped.
        seed: of everything drawn.

    Raises:
        ValueError: naming the setting, what was expected and what was given.
    """

    states: int = 256
    actions: int = 128
    steps: int = 200
    uniform: bool = True
    examples: int = 3
    strict: bool = False
    seed: int = 0

    def __post_init__(self) -> None:
        for name, expected in _EXPECTED.items():
            expected.require(f"audit.{name}", getattr(self, name))


@torch.no_grad()
def audit(
    env: EnvBase,
    bijectors: Sequence[ConstraintBijector] | None = None,
    *,
    order: Sequence[str] | None = None,
    flow: Flow | str = "exact",
    actor: SafeProbabilisticTensorDictSequential | None = None,
    indicators: Mapping[str, Indicator] | None = None,
    place: Place | None = None,
    settings: AuditSettings | None = None,
) -> AuditReport:
    """Audit the geometry that an environment publishes; see the module for what is asked.

    Any environment will do that has these three:

    - geometry, anchor and active flags: `cnfp_torchrl.envs.constrain_env` publishes them;
    - judges, by the constraints' names: a `cnfp_torchrl.envs.ConstraintCost` with indicators, or
      its own ``cost`` and ``constraint_names``, or `indicators`;
    - a way back into a state, to try many actions in it: ``copy.deepcopy`` keeps its state, as
      with environments in PyTorch and Gymnasium's classic control, but not with MuJoCo; or `place`,
      which is faster::

        def place(env, states):  # env without its transforms, states of its batch size
            env.my_state = states["observation"].clone()
            return TensorDict({"observation": env.my_observation()}, env.batch_size)

    States come from rollouts and, with `place`, also uniformly from the observation spec (normally
    distributed where that is unbounded).

    Args:
        env: the environment; it is reset. With a larger batch the audit is faster.
        bijectors: one for each constraint; None takes those of the geometry transforms.
        order: see `cnfp_torchrl.modules.ConstrainedFlowModule`.
        flow: see `cnfp_torchrl.modules.ConstrainedFlowModule`.
        actor: a constrained one that acts in the rollouts, and whose flow is audited instead; None
            takes safe random actions.
        indicators: named indicators that judge a step; None takes the environment's ``cost``.
        place: puts the environment into given states, see `Place`; None knows point navigation,
            and copies any other environment.
        settings: how much is tried.

    Raises:
        ValueError: when the environment publishes no geometry, or no indicator judges any of it.
        TypeError: when there is no `place` and the environment cannot be copied with its state.
    """
    settings = AuditSettings() if settings is None else settings
    head = _head(env, bijectors, order, flow) if actor is None else flow_head(actor)
    reader = Reader(env, head, indicators)
    if not set(reader.names) & set(head.order):
        raise ValueError(
            f"indicators: expected one for at least one of the constraints {head.order}, given "
            f"{list(reader.names)}; give geometry and indicator the same name"
        )
    place = known_place(env) if place is None else place
    keys = state_keys(env)
    copies = 0 if place else -(-settings.states // env.batch_size.numel())
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(settings.seed)
        env.set_seed(settings.seed)
        policy = head.random if actor is None else actor
        # Each copy is of another time.
        steps = max(settings.steps, copies)
        record = roll_out(env, policy, reader, steps=steps, copies=copies)
        probes: dict[str, Probe] = {}
        if place is None:
            probes["rollouts"] = CopiedProbe(record.copies, reader)
        else:
            seen = record.states.reshape(-1)
            chosen = seen[torch.randperm(len(seen))[: settings.states]]
            probes["rollouts"] = PlacedProbe(env, place, chosen, reader)
            if settings.uniform:
                anywhere = uniform_states(env, place, settings.states)
                probes["uniform"] = PlacedProbe(env, place, anywhere, reader)
        trials = {
            source: run_trial(probe, head, keys, reader.names, settings.actions)
            for source, probe in probes.items()
        }
    scenes = [
        max((worst_scene(trial, name, source) for source, trial in trials.items()), key=_first)[1]
        for name in head.order
    ]
    return AuditReport(
        subject={
            "environment": type(bare(env)).__name__,
            "flow": type(head.flow).__name__,
            "policy": "safe random" if actor is None else "actor",
            "judged by": "copies" if place is None else "placing",
            "settings": asdict(settings),
        },
        sources={name: findings(trial, settings.examples) for name, trial in trials.items()},
        executed=executed(record, reader, head, keys, settings.examples),
        order=tuple(head.order),
        notes=tuple(_notes(head.order, reader.names, place)),
        strict=settings.strict,
        scenes=tuple(scenes),
    )


def _first(scored: tuple[float, Any]) -> float:
    return scored[0]


def _head(
    env: EnvBase,
    bijectors: Sequence[ConstraintBijector] | None,
    order: Sequence[str] | None,
    flow: Flow | str,
) -> ConstrainedFlowModule:
    bijectors = constraint_bijectors(env) if bijectors is None else bijectors
    if not bijectors:
        raise ValueError(
            "bijectors: expected one for at least one constraint, given none; leave them out to "
            "take those of the environment's geometry transforms"
        )
    return ConstrainedFlowModule(
        env.action_spec_unbatched, bijectors, order=order, flow=flow, out_key=env.action_key
    )


def _notes(order: Sequence[str], indicators: Sequence[str], place: Place | None) -> list[str]:
    notes = [
        f"{name}: no indicator of this name, so that its soundness and coverage are not judged"
        for name in order
        if name not in indicators
    ]
    notes += [
        f"{name}: an indicator without geometry of this name; nothing keeps the flow from violating"
        for name in indicators
        if name not in order
    ]
    if place is None:
        notes.append(
            "states from rollouts only: the environment cannot be put into a chosen state; pass "
            "place to look at uniform states, too"
        )
    return notes
