"""Time environment, update and layer on a GPU beside unconstrained ones, and count violations.

`python experiments/benchmarks/gpu.py [--out FOLDER] [--device cpu] [--quick] [--no-compile]` needs
the core packages alone and takes some minutes. It measures

- environment steps a second of point navigation, plain and constrained, and with an actor in a
  collector, unconstrained and constrained;
- a SAC update: the exact flow with this library's loss, an unconstrained actor with the same loss,
  and TorchRL's own SACLoss with a TanhNormal; eager, and compiled for one size;
- the layer alone: drawing actions with their log-densities, and the backward pass, of the exact
  flow constructed at each call beside a TanhNormal that is, too;
- violations among at least ten million float32 actions with TF32 on, latents up to 1e6;
- how often the host waits for the GPU in a step and in an update.

In a round all that is compared takes its turn; ratios are taken within a round.
"""

from __future__ import annotations

import argparse
import platform
import sys
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import torch
from interleaved import (
    ROUNDS,
    Call,
    Replay,
    Rows,
    compared,
    point_nav_start,
    processor,
    rounds,
    versions,
    wait,
    write,
)
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torch.distributions import Independent, Normal
from torchrl.collectors import Collector
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import MLP, NormalParamExtractor, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import SACLoss, SoftUpdate
from waits import waits

from cnfp_torchrl import (
    Ball,
    Box,
    ConstrainedFlow,
    ConstraintSet,
    HalfSpaces,
    Region,
    WeightedL1Ball,
    constrain_env,
    make_constrained_actor,
)
from cnfp_torchrl.bijectors import ExactSquash
from cnfp_torchrl.objectives import ConstrainedSACLoss, FusedSoftUpdate
from cnfp_torchrl.tasks.point_nav import BatteryGeometry, ObstacleGeometry, PointNavEnv
from cnfp_torchrl.training.update import Update

RESULTS = Path(__file__).resolve().parents[1] / "results"
STARTED = time.perf_counter()


class Sizes:
    """What is measured: all of it, or little for a test."""

    def __init__(self, *, quick: bool) -> None:
        self.agents = [32] if quick else [4096, 65536]
        self.batches = [16] if quick else [256, 4096]
        self.widths = [8] if quick else [64, 256]
        self.layers = [64] if quick else [4096, 65536]
        self.rounds = 2 if quick else ROUNDS
        self.seconds = 0.01 if quick else 0.15
        self.actions = 10_000 if quick else 12_000_000
        self.collected = 4 if quick else 32
        self.settled = 4 if quick else 80  # steps until nobody watches relaxation any more

    def timed(self, calls: Mapping[str, Call], device: torch.device) -> dict[str, list[float]]:
        """Return the seconds of a call of each kind in each round."""
        return rounds(calls, self.rounds, self.seconds, device)


def network(width: int, device: torch.device) -> nn.Module:
    """Return a Gaussian's network for point navigation."""
    layers = MLP(5, 4, num_cells=[width, width], device=device)
    return nn.Sequential(layers, NormalParamExtractor())


def constrained(agents: int, device: torch.device) -> EnvBase:
    """Return point navigation with its two constraints."""
    return constrain_env(
        PointNavEnv([agents], device=device, seed=0), BatteryGeometry(), ObstacleGeometry()
    )


def tanh_actor(env: EnvBase, width: int, device: torch.device) -> ProbabilisticActor:
    """Return TorchRL's unconstrained actor."""
    spec = env.action_spec_unbatched
    bounds = {"low": spec.space.low, "high": spec.space.high}
    return ProbabilisticActor(
        TensorDictModule(network(width, device), ["observation"], ["loc", "scale"]),
        spec=spec,
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        distribution_kwargs=bounds,
        default_interaction_type=ExplorationType.RANDOM,
    )


def replays(agents: int, device: torch.device) -> dict[str, Replay]:
    """Return the steps of the plain and of the constrained environment."""
    env = constrained(agents, device)
    actor = make_constrained_actor(network(64, device), env)
    recorded = env.rollout(40, actor, break_when_any_done=False)
    plain, start = PointNavEnv([agents], device=device), point_nav_start(recorded)
    return {"plain": Replay(plain, recorded, start), "constrained": Replay(env, recorded, start)}


def collecting(env: EnvBase, policy: nn.Module, steps: int) -> Call:
    """Return a call of one batch of a collector."""
    collector = Collector(
        env,
        policy,
        frames_per_batch=steps * env.batch_size.numel(),
        total_frames=-1,
        auto_register_policy_transforms=False,
        no_cuda_sync=True,
    )
    iterator = iter(collector)
    return lambda: next(iterator)


@torch.no_grad()
def time_environment(sizes: Sizes, device: torch.device) -> dict[str, Rows]:
    """Return steps a second, plain and constrained, alone and in a collector."""
    results = {}
    for agents in sizes.agents:
        steps: dict[str, Call] = dict(replays(agents, device))
        for call in steps.values():
            for _ in range(sizes.settled):
                call()
        results[f"step of {agents} agents"] = compared(sizes.timed(steps, device), "plain", agents)
        plain, env = PointNavEnv([agents], device=device), constrained(agents, device)
        actor = make_constrained_actor(network(64, device), env)
        calls = {
            "unconstrained": collecting(plain, tanh_actor(plain, 64, device), sizes.collected),
            "constrained": collecting(env, actor, sizes.collected),
        }
        times = sizes.timed(calls, device)
        title = f"collector, {agents} agents, actor of width 64"
        results[title] = compared(times, "unconstrained", agents * sizes.collected)
    return results


def critic(width: int, device: torch.device) -> ValueOperator:
    """Return a critic for point navigation."""
    layers = MLP(7, 1, num_cells=[width, width], device=device)
    return ValueOperator(layers, in_keys=["observation", "action"])


def update_of(kind: str, batch: int, width: int, device: torch.device, *, compiled: bool) -> Update:
    """Return an update of the flow, of no flow, or of TorchRL's own loss."""
    env = constrained(batch, device)
    spec = env.action_spec_unbatched
    if kind == "TorchRL's SACLoss, TanhNormal":
        loss = SACLoss(
            tanh_actor(env, width, device), critic(width, device), action_spec=spec, max_alpha=10.0
        )
        loss.make_value_estimator(gamma=0.95)
        target = SoftUpdate(loss, tau=0.005)
    else:
        flow = "exact" if kind == "exact flow" else "unconstrained"
        actor = make_constrained_actor(network(width, device), env, flow=flow)
        loss = ConstrainedSACLoss(actor, critic(width, device), action_spec=spec, gamma=0.95)
        target = FusedSoftUpdate(loss, tau=0.005)
    loss.to(device)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3, fused=True)
    return Update(loss, optimizer, target, compiled=compiled)


KINDS = ("TorchRL's SACLoss, TanhNormal", "unconstrained, this loss", "exact flow")


def updating(
    batch: int, width: int, device: torch.device, *, compiled: bool = False
) -> dict[str, Call]:
    """Return a call of an update of each kind, on one batch of transitions."""
    env = constrained(batch, device)
    with torch.no_grad():
        actor = make_constrained_actor(network(width, device), env)
        transitions = env.rollout(1, actor).reshape(-1)
    calls: dict[str, Call] = {}
    for kind in KINDS:
        update = update_of(kind, batch, width, device, compiled=compiled)
        calls[kind] = partial(update, transitions)
    return calls


def time_updates(sizes: Sizes, device: torch.device) -> dict[str, Rows]:
    """Return the time of an update for each batch size and width."""
    return {
        f"update, batch {batch}, width {width}": compared(
            sizes.timed(updating(batch, width, device), device), KINDS[0]
        )
        for batch in sizes.batches
        for width in sizes.widths
    }


def time_compiled(sizes: Sizes, device: torch.device) -> dict[str, Rows]:
    """Return the time of a compiled update of the smallest size, and of its warm-up."""
    batch, width = sizes.batches[0], sizes.widths[-1]
    calls, warm_up = updating(batch, width, device, compiled=True), {}
    eager = updating(batch, width, device)
    for kind in list(calls):
        started = time.perf_counter()
        for _ in range(3):
            calls[kind]()
        wait(device)
        warm_up[kind] = time.perf_counter() - started
    both = {KINDS[0]: eager[KINDS[0]]} | {f"{kind}, compiled": calls[kind] for kind in KINDS}
    rows = compared(sizes.timed(both, device), KINDS[0])
    for kind, seconds in warm_up.items():
        rows[f"{kind}, compiled"]["warm-up, s"] = seconds
    return {f"update compiled, batch {batch}, width {width}": rows}


def layer_problem(batch: int, dim: int, count: int, device: torch.device) -> list[ConstraintSet]:
    """Return bounds and one or two sets that bind, about a common anchor at 0."""
    ones = torch.ones(dim, device=device)
    radius = 0.4 * dim**0.5 + torch.rand(batch, device=device)
    center = 0.1 * torch.randn(batch, dim, device=device)
    sets: list[ConstraintSet] = [Box(-ones, ones), Ball(center, radius)]
    sides = 0.2 + torch.rand(2, batch, dim, device=device)
    return [*sets, Box(-sides[0], sides[1])][: 1 + count]


def time_layer(sizes: Sizes, device: torch.device) -> dict[str, Rows]:
    """Return the time of drawing and scoring, constructed at each call, with the backward pass."""
    results = {}
    for batch in sizes.layers:
        for dim in (2, 6):
            loc = torch.randn(batch, dim, device=device, requires_grad=True)
            scale = (0.1 + torch.rand(batch, dim, device=device)).requires_grad_()
            ones = torch.ones(dim, device=device)

            def tanh(
                loc: Tensor = loc, scale: Tensor = scale, ones: Tensor = ones
            ) -> tuple[Tensor, Tensor]:
                return TanhNormal(loc, scale, low=-ones, high=ones).rsample_and_log_prob()

            calls: dict[str, Callable[[], tuple[Tensor, Tensor]]] = {"TanhNormal": tanh}
            for count in (1, 2):
                sets = tuple(layer_problem(batch, dim, count, device))
                anchor = torch.zeros(batch, dim, device=device)
                active = torch.ones(batch, count + 1, dtype=torch.bool, device=device)
                zero = tuple(torch.zeros(batch, 1, device=device) for _ in sets)

                def flow(
                    sets: Any = sets,
                    anchor: Tensor = anchor,
                    active: Tensor = active,
                    zero: Any = zero,
                    loc: Tensor = loc,
                    scale: Tensor = scale,
                ) -> tuple[Tensor, Tensor]:
                    region = Region(sets, anchor, active, zero, validate_args=False)
                    base = Independent(Normal(loc, scale, validate_args=False), 1)
                    squash = ExactSquash(region, validate_args=False)
                    return ConstrainedFlow(base, squash).rsample_and_log_prob()

                calls[f"exact flow, K = {count}"] = flow

            def backward(call: Callable[[], tuple[Tensor, Tensor]]) -> Call:
                return lambda: sum(part.sum() for part in call()).backward()  # type: ignore[union-attr]

            title = f"layer, batch {batch}, d = {dim}"
            results[title] = compared(sizes.timed(calls, device), "TanhNormal")
            with_backward = {name: backward(call) for name, call in calls.items()}
            results[f"{title}, with the backward pass"] = compared(
                sizes.timed(with_backward, device), "TanhNormal"
            )
    return results


def hostile_sets(batch: int, dim: int, device: torch.device) -> list[ConstraintSet]:
    """Return sets of which one in ten has states in which it must give way."""
    middle = 0.6 * torch.rand(batch, dim, device=device) - 0.3
    gone = torch.rand(batch, 1, device=device) < 0.1
    normals = torch.randn(batch, 2, dim, device=device)
    weights = torch.randn(batch, dim, device=device)
    ones = torch.ones(dim, device=device)
    room = 10 ** (-3 * torch.rand(batch, device=device))
    return [
        Box(-ones, ones),
        WeightedL1Ball(weights, (weights * middle).abs().sum(-1) + room),
        HalfSpaces(normals, (normals * middle.unsqueeze(-2)).sum(-1) + room.unsqueeze(-1)),
        Ball(torch.where(gone, 4 * middle.sign(), middle), 0.2 + room),
        Box(middle - room.unsqueeze(-1), middle + 0.3),
    ]


@torch.no_grad()
def count_violations(sizes: Sizes, device: torch.device) -> dict[str, Rows]:
    """Return how many float32 actions lie outside of a set, and how many the judge objects to."""
    rows, batch = {}, min(sizes.actions // 4, 1_000_000)
    states = min(batch, 20_000)
    for dim in (2, 6):
        region = Region.build(hostile_sets(states, dim, device))
        bijector, done, bad = ExactSquash(region), 0, 0
        while done < sizes.actions // 2:
            shape = (batch // states, states, 1)
            size = 10 ** (14 * torch.rand(shape, device=device) - 8)
            latent = size * torch.randn(*shape[:2], dim, device=device)
            outside = ~region.contains(bijector(latent))
            bad, done = bad + int(outside.sum()), done + outside.numel()
        relaxed = float((~region.is_active).any(-1).float().mean())
        rows[f"random sets, d = {dim}"] = {
            "actions": done,
            "violations": bad,
            "share of relaxed states": relaxed,
        }
    agents = sizes.agents[-1]
    env = constrained(agents, device)

    def hostile(state: TensorDictBase) -> TensorDictBase:
        size = 10 ** (14 * torch.rand(agents, 1, device=device) - 8)
        loc = size * torch.randn(agents, 2, device=device)
        return head(state.set("loc", loc).set("scale", torch.ones_like(loc)))

    head = make_constrained_actor(network(8, device), env)[-1]
    steps = max(1, sizes.actions // agents)
    state, cost = env.reset(), torch.zeros(2, device=device)
    with set_exploration_type(ExplorationType.RANDOM):
        for _ in range(steps):
            step = env.step(hostile(state))
            cost += step["next", "cost"].sum(0)
            state = env.step_mdp(step)
    rows["point navigation, judged by the environment"] = {
        "actions": steps * agents,
        "violations": int(cost.sum()),
        "share of relaxed states": 0.0,
    }
    return {"violations in float32, TF32 on, latents up to 1e6": rows}


def count_waits(sizes: Sizes, device: torch.device) -> dict[str, Rows]:
    """Return how often the host waits in a step and in an update."""
    if device.type != "cuda":
        return {}
    agents = sizes.agents[0]
    with torch.no_grad():
        steps = replays(agents, device)
    env = constrained(agents, device)
    state, actor = env.reset(), make_constrained_actor(network(64, device), env)
    calls: dict[str, Call] = {f"{name} step": step for name, step in steps.items()}
    calls |= {"constrained actor": lambda: actor(state)}
    calls |= {f"update, {kind}": call for kind, call in updating(256, 64, device).items()}
    rows: Rows = {}
    for name, call in calls.items():
        with torch.set_grad_enabled(name.startswith("update")):
            for _ in range(sizes.settled + 3):  # not the last step before a reset
                call()
            rows[name] = {"waits": waits(call)}
    return {"waits for the GPU": rows}


def about(device: torch.device, sizes: Sizes) -> dict[str, Any]:
    """Return what the numbers depend on."""
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else platform.machine()
    return {
        "command": f"python experiments/benchmarks/gpu.py {' '.join(sys.argv[1:])}".rstrip(),
        "device": name,
        "processor": processor(),
        "CUDA": torch.version.cuda,
        "rounds": sizes.rounds,
        **versions(),
    }


def main() -> None:
    """Measure everything, and write after each part."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of gpu.json and gpu.md")
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--quick", action="store_true", help="little of everything, for a test")
    parser.add_argument("--no-compile", action="store_true", help="leave the compiled update out")
    parser.add_argument("--seconds", type=float, default=150.0, help="until compiling may begin")
    arguments = parser.parse_args()
    device = torch.device(arguments.device)
    if device.type == "cuda":
        device = torch.device("cuda", torch.cuda.current_device())
    sizes = Sizes(quick=arguments.quick)
    torch.manual_seed(0)
    torch.set_float32_matmul_precision("high")  # TF32, which may not break a constraint either
    circumstances = about(device, sizes)
    results: dict[str, Rows] = {}
    parts = [count_violations, count_waits, time_environment, time_updates, time_layer]
    if not (arguments.no_compile or arguments.quick):
        parts.append(time_compiled)
    for part in parts:
        spent = time.perf_counter() - STARTED
        if part is time_compiled and spent > arguments.seconds:
            circumstances["compiled update"] = f"left out after {spent:.0f} s"
            continue
        try:  # the other parts are not lost with one of them
            results |= part(sizes, device)
        except Exception as error:
            circumstances[f"{part.__name__} failed"] = f"{type(error).__name__}: {error}"[:500]
        circumstances["seconds"] = round(time.perf_counter() - STARTED, 1)
        print(part.__name__, circumstances["seconds"], "s", flush=True)
        write(arguments.out / "gpu.json", "On a GPU", circumstances, results)
    print((arguments.out / "gpu.md").read_text())
    failed = [key for key in circumstances if key.endswith("failed")]
    broken = [row for rows in results.values() for row in rows.values() if row.get("violations")]
    if failed or broken:
        sys.exit(f"failed: {failed}; violations: {broken}")


if __name__ == "__main__":
    main()
