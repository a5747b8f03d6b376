"""Export of a constrained policy to one graph, from the observation to the allowed action."""

from cnfp_torchrl.deploy.export import FORMATS, export_policy, open_exported
from cnfp_torchrl.deploy.policy import DeployedPolicy
from cnfp_torchrl.deploy.self_test import observed_states, self_test

__all__ = [
    "FORMATS",
    "DeployedPolicy",
    "export_policy",
    "observed_states",
    "open_exported",
    "self_test",
]
