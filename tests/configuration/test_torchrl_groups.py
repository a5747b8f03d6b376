"""Our parts in TorchRL's groups of configurations, and its own trainer that trains with them."""

import sys
from copy import deepcopy
from dataclasses import fields
from functools import cache
from importlib import import_module, reload
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore
from hydra.core.plugins import Plugins
from hydra.utils import get_object, instantiate
from omegaconf import OmegaConf
from tensordict import TensorDict

from cnfp_torchrl.envs import ActionGuard, ConstrainedActions, appended_transforms
from cnfp_torchrl.modules import flow_head
from cnfp_torchrl.objectives import ConstrainedSACLoss

EXAMPLES = Path(__file__).resolve().parents[2] / "experiments" / "examples"
OUR_MODULE = "cnfp_torchrl.configuration.torchrl_groups"
OURS = {
    "env": ["constrained"],
    "transform": ["action_guard", "constrained_actions", "constraint_cost", "reward_penalty"],
    "model": ["constrained_actor"],
    "loss": ["constrained_sac"],
    "logger": ["rerun"],
}


@cache
def registered() -> tuple[ModuleType, Any]:
    """Return our module of groups, and a store with TorchRL's groups and ours.

    They register themselves when they are imported, which takes seconds. Hydra's own store stays as
    it was: commands that are composed later in the same process would be checked against groups of
    TorchRL's that have the names of ours.
    """
    Plugins.instance()  # registers Hydra's own, once a process
    store = ConfigStore.instance()
    before = deepcopy(store.repo)
    try:
        for name in ("torchrl.trainers.algorithms.configs", OUR_MODULE):
            # An example may have imported them before, into a store that is gone.
            reload(sys.modules[name]) if name in sys.modules else import_module(name)
        return sys.modules[OUR_MODULE], store.repo
    finally:
        store.repo = before


@pytest.fixture(autouse=True)
def groups(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    module, repo = registered()
    monkeypatch.setattr(ConfigStore.instance(), "repo", repo)
    return module


def trainer_config(*overrides: str) -> Any:
    with initialize_config_dir(str(EXAMPLES), version_base="1.3"):
        return compose("torchrl_trainer", overrides=list(overrides))


@pytest.mark.parametrize(("group", "name"), [(g, n) for g, names in OURS.items() for n in names])
def test_registered_beside_torchrls(group: str, name: str) -> None:
    known = ConfigStore.instance().list(group)
    assert f"{name}.yaml" in known
    assert len(known) > 1
    node = ConfigStore.instance().load(f"{group}/{name}.yaml").node
    assert callable(get_object(node["_target_"]))


def test_the_table_of_the_module_lists_them(groups: ModuleType) -> None:
    for group, names in OURS.items():
        for name in names:
            assert f"| ``{group}`` | ``{name}`` |" in (groups.__doc__ or "")


def test_transforms_are_made_and_fields_are_arguments(groups: ModuleType) -> None:
    for node, made in (
        (groups.ActionGuardConfig(), ActionGuard),
        (groups.ConstrainedActionsConfig(unbounded=True), ConstrainedActions),
    ):
        assert isinstance(instantiate(OmegaConf.structured(node)), made)
        assert {field.name for field in fields(node)} - {"_target_"}


# Of TorchRL's trainers themselves.
@pytest.mark.filterwarnings("ignore:SACTrainer is an experimental")
@pytest.mark.filterwarnings("ignore:The '.*' hook stage will be replaced:FutureWarning")
def test_torchrls_trainer_trains_within_the_constraints() -> None:
    torch.manual_seed(0)
    config = trainer_config("steps=256", "agents=8", "trainer.optim_steps_per_batch=4")
    trainer = instantiate(config.trainer)
    assert isinstance(trainer.loss_module, ConstrainedSACLoss)
    env = trainer.collector.env
    assert any(isinstance(transform, ActionGuard) for transform in appended_transforms(env))
    acting = trainer.collector.policy
    assert flow_head(acting).order == ["battery", "obstacle"]
    first = TensorDict.from_module(acting).data.clone()
    costs = []
    trainer.register_op("pre_steps_log", lambda td: costs.append(td["next", "cost"]))
    trainer.train()
    assert trainer.collected_frames == 256
    assert torch.cat([cost.flatten(0, -2) for cost in costs]).sum() == 0
    learned = TensorDict.from_module(trainer.loss_module.actor_network).data
    now = TensorDict.from_module(acting).data
    # The collector's actor is another object, and has the loss's weights.
    for key, value in now.items(True, True):
        assert not torch.equal(value, first[key])
        torch.testing.assert_close(value, learned[key])
