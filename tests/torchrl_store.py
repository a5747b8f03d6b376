"""TorchRL's groups of configurations, kept out of the store that Hydra's commands read.

TorchRL registers groups of the names that ours have when its module is imported; commands that are
composed later in the same process would be checked against them.
"""

from copy import deepcopy
from functools import cache
from importlib import import_module
from types import ModuleType
from typing import Any

from hydra.core.config_store import ConfigStore
from hydra.core.plugins import Plugins


@cache
def registered() -> tuple[ModuleType, Any]:
    """Return our module of groups, and a store with TorchRL's groups and ours.

    Call it before whatever may import one of them.
    """
    Plugins.instance()  # registers Hydra's own, once a process
    store = ConfigStore.instance()
    before = deepcopy(store.repo)
    try:
        import_module("torchrl.trainers.algorithms.configs")
        module = import_module("cnfp_torchrl.configuration.torchrl_groups")
        return module, store.repo
    finally:
        store.repo = before
