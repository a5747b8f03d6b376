"""The audit of the geometry that an environment publishes against the environment's own indicators.

Two things are asked in many states. *Soundness*: does an indicator call any action a violation that
the geometry allows? *Coverage*: which share of the actions that the indicators allow lies in the
geometry's sets?

The indicators judge one step. A set may be smaller than what one step allows because it plans
ahead: a braking car needs the whole way. That lowers the coverage and is no flaw; it is what
keeps the policy from *dead ends*, states in which the constraint has to give way. Whether it
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

from cnfp_torchrl.audit.distortion import measure_distortion
from cnfp_torchrl.audit.lookahead import (
    CopyLookahead,
    Lookahead,
    StateSetterLookahead,
    StepReader,
)
from cnfp_torchrl.audit.metrics import executed, measure, worst_state
from cnfp_torchrl.audit.report import AuditReport
from cnfp_torchrl.audit.rollouts import roll_out
from cnfp_torchrl.audit.samples import draw_samples
from cnfp_torchrl.audit.states import bare, state_keys, uniform_states
from cnfp_torchrl.configuration import require_fields
from cnfp_torchrl.envs import (
    Indicator,
    StateSetter,
    action_components,
    constraint_bijectors,
    find_task_view,
    refuse_misnamed_judges,
)
from cnfp_torchrl.modules import ConstrainedFlowModule, ConstraintBijector, Flow, flow_head


@dataclass(frozen=True)
class AuditSettings:
    """The extent of an audit.

    Args:
        states: The number of states from each source.
        actions: The number of actions through the flow, and of uniform ones, in each state.
        steps: The length of the rollouts that states are taken from; more where copies need it.
        uniform: Whether to draw states uniformly, too, where the environment can be
            put into them.
        examples: The number of examples of each kind of flaw that are kept.
        strict: Whether dead ends count as flaws, for geometry that promises never to give way.
        seed: The seed of everything drawn.

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
        require_fields("audit", self)


_WISHES = 20
"""The number of allowed actions in each state that distortion is measured at."""


@torch.no_grad()
def audit(
    env: EnvBase,
    bijectors: Sequence[ConstraintBijector] | None = None,
    *,
    order: Sequence[str] | None = None,
    flow: Flow | str = "exact",
    actor: SafeProbabilisticTensorDictSequential | None = None,
    indicators: Mapping[str, Indicator] | None = None,
    state_setter: StateSetter | None = None,
    settings: AuditSettings | None = None,
) -> AuditReport:
    """Audit the geometry that an environment publishes; see the module for what is asked.

    Any environment will do that has these three:

    - geometry, anchor and active flags: `cnfp_torchrl.envs.constrain_env` publishes them;
    - judges, by the constraints' names: a `cnfp_torchrl.envs.ConstraintCost` with indicators, or
      its own ``cost`` and ``constraint_names``, or `indicators`;
    - a way back into a state, to try many actions in it: ``copy.deepcopy`` keeps its state, as
      with environments in PyTorch and Gymnasium's classic control, but not with MuJoCo; or a state
      setter, which is faster::

        def set_state(env, states):  # env without its transforms, states of its batch size
            env.my_state = states["observation"].clone()
            return TensorDict({"observation": env.my_observation()}, env.batch_size)

    States come from rollouts and, with a state setter, also from the observation spec: uniformly
    distributed, and normally where that is unbounded.

    Args:
        env: The environment, which is reset. With a larger batch the audit is faster.
        bijectors: Bijectors, one for each constraint; None takes those of the geometry transforms.
        order: The constraints' names in order of application, see
            `cnfp_torchrl.modules.ConstrainedFlowModule`.
        flow: The flow, see `cnfp_torchrl.modules.ConstrainedFlowModule`.
        actor: A constrained actor that acts in the rollouts, and whose flow is audited instead;
            None takes safe random actions.
        indicators: Named indicators that judge a step; None takes the environment's ``cost``.
        state_setter: The function that puts the environment into given states; None takes that of
            the environment's `cnfp_torchrl.envs.TaskView`, and copies environments without one.
        settings: The extent of the audit.

    Raises:
        ValueError: when the environment publishes no geometry, or no indicator judges any of it,
            and for one of nearly a constraint's name.
        TypeError: when the environment has no state setter and cannot be copied with its state.
    """
    settings = AuditSettings() if settings is None else settings
    head = _head(env, bijectors, order, flow) if actor is None else flow_head(actor)
    reader = StepReader(env, head, indicators)
    refuse_misnamed_judges(head.order, reader.names)
    if not set(reader.names) & set(head.order):
        raise ValueError(
            f"indicators: expected one for at least one of the constraints {head.order}, given "
            f"{list(reader.names)}; give geometry and indicator the same name"
        )
    if state_setter is None:
        state_setter = find_task_view(env).state_setter
    keys = state_keys(env)
    copies = 0 if state_setter else -(-settings.states // env.batch_size.numel())
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(settings.seed)
        env.set_seed(settings.seed)
        policy = head.random if actor is None else actor
        # Each copy is of another time.
        steps = max(settings.steps, copies)
        rollouts = roll_out(env, policy, reader, steps=steps, copies=copies)
        lookaheads: dict[str, Lookahead] = {}
        if state_setter is None:
            lookaheads["rollouts"] = CopyLookahead(rollouts.copies, reader)
        else:
            seen = rollouts.states.reshape(-1)
            chosen = seen[torch.randperm(len(seen))[: settings.states]]
            lookaheads["rollouts"] = StateSetterLookahead(env, state_setter, chosen, reader)
            if settings.uniform:
                drawn = uniform_states(env, state_setter, settings.states)
                lookaheads["uniform"] = StateSetterLookahead(env, state_setter, drawn, reader)
        samples = {
            source: draw_samples(lookahead, head, keys, reader.names, settings.actions)
            for source, lookahead in lookaheads.items()
        }
        distortion = {
            source: measure_distortion(head.flow, drawn.region, _WISHES)
            for source, drawn in samples.items()
            if head.flow.is_safe
        }
    worst = [
        max((worst_state(drawn, name, source) for source, drawn in samples.items()), key=_first)[1]
        for name in head.order
    ]
    return AuditReport(
        subject={
            "environment": type(bare(env)).__name__,
            "names": {
                "action": [part.title for part in action_components(env, head.action_dim)],
                "observation": [part.title for part in find_task_view(env).observation_components],
            },
            "flow": type(head.flow).__name__,
            "policy": "safe random" if actor is None else "actor",
            "judged by": "copies" if state_setter is None else "state setter",
            "settings": asdict(settings),
        },
        sources={source: measure(drawn, settings.examples) for source, drawn in samples.items()},
        distortion=distortion,
        executed=executed(rollouts, reader, head, keys, settings.examples),
        order=tuple(head.order),
        notes=tuple(_notes(head.order, reader.names, state_setter)),
        strict=settings.strict,
        worst_states=tuple(worst),
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


def _notes(
    order: Sequence[str], indicators: Sequence[str], state_setter: StateSetter | None
) -> list[str]:
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
    if state_setter is None:
        notes.append(
            "states from rollouts only: the environment cannot be put into a chosen state; pass "
            "a state_setter to look at uniform states, too"
        )
    return notes
