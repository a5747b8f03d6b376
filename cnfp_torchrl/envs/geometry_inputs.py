"""The geometry as an input of transforms that need it at a step."""

from __future__ import annotations

from torchrl.data import Composite

from cnfp_torchrl.modules import ConstrainedFlowModule


def with_geometry(
    input_spec: Composite, published: Composite, head: ConstrainedFlowModule
) -> Composite:
    """Return an input spec with what a flow reads at the root of a step.

    Without it batched environments would not pass the geometry to their workers.

    Args:
        input_spec: The spec to add to; changed in place.
        published: The environment's observation spec.
        head: The flow module.

    Raises:
        ValueError: when the environment does not publish what the flow reads.
    """
    state_spec = input_spec["full_state_spec"]
    if state_spec is None:
        state_spec = Composite(shape=input_spec.shape, device=input_spec.device)
    for key in head.geometry_keys():
        if key not in published.keys(True, True):
            raise ValueError(
                f"env: expected one that publishes {key}, given one that does not; make it with "
                "constrain_env"
            )
        state_spec[key] = published[key].clone()
    input_spec["full_state_spec"] = state_spec
    return input_spec
