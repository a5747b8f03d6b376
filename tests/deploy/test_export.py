"""Exported files: whole, told by their manifest, and as safe as the policy itself."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from tensordict import TensorDictBase
from torchrl.envs import TransformedEnv

from cnfp_torchrl import GeometryTransform, HalfSpaces, constrain_env
from cnfp_torchrl.deploy import (
    FORMATS,
    DeployedPolicy,
    export_policy,
    observed_states,
    open_exported,
    self_test,
)
from cnfp_torchrl.deploy.self_test import latencies, with_noise
from cnfp_torchrl.tasks.point_nav import ObstacleGeometry, PointNavEnv
from experiments.exported import DIMENSIONS, policy_of
from tests.deploy.conftest import actor_for

WITHOUT_TORCH = """
import json, sys
import numpy as np, onnxruntime
manifest = json.load(open("manifest.json"))
policy = onnxruntime.InferenceSession(manifest["file"])
(entry,) = manifest["inputs"]
states = np.load("states.npy").astype(entry["dtype"])
action, certified = policy.run(["action", "certified"], {entry["name"]: states})
assert "torch" not in sys.modules
assert action.shape == (len(states), len(manifest["action_bounds"]["low"]))
one, _ = policy.run(None, {entry["name"]: states[:1]})
assert np.allclose(one, action[:1], atol=1e-5)
np.savez("answers.npz", action=action, certified=certified)
"""


@pytest.fixture(autouse=True)
def installed() -> None:
    pytest.importorskip("onnxruntime", reason="of the extra 'export'")
    pytest.importorskip("onnxscript", reason="of the extra 'export'")


# Of the exporters themselves.
COMPILERS = pytest.mark.filterwarnings("ignore")


@COMPILERS
def test_onnx_file_and_manifest_are_enough_without_torch(tmp_path: Path) -> None:
    env = constrain_env(PointNavEnv([64], seed=0), ObstacleGeometry())
    actor = actor_for(env)
    # Small, without steps inwards; with them, with two constraints, in all families: slow tests.
    policy = DeployedPolicy(actor, env, steps=0)
    file = export_policy(policy, tmp_path)
    manifest = json.loads((tmp_path / "manifest.json").read_text())
    assert file.name == manifest["file"]
    assert manifest["inputs"] == [
        {"name": "observation", "dtype": "float32", "shape": ["batch", 5]}
    ]
    assert manifest["constraints"] == [{"name": "obstacle", "family": "Box"}]
    assert manifest["action_bounds"] == {"low": [-1, -1], "high": [1, 1]}
    assert manifest["versions"]["onnxruntime"]

    states = observed_states(policy, env, actor, 2000)
    np.save(tmp_path / "states.npy", states[0].numpy())
    subprocess.run([sys.executable, "-I", "-c", WITHOUT_TORCH], cwd=tmp_path, check=True)
    answers = np.load(tmp_path / "answers.npz")

    def answered(*inputs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return torch.tensor(answers["action"]), torch.tensor(answers["certified"])

    found = self_test(policy, answered, states)
    assert found["violations"] == found["fallback_out_of_bounds"] == 0
    assert found["certified"] > 0.9 * 2000
    assert found["largest_difference"] < 1e-4

    with pytest.raises(FileExistsError, match=r"policy\.onnx.*nothing is overwritten"):
        export_policy(policy, tmp_path)
    with file.open("ab") as changed:
        changed.write(b" ")
    with pytest.raises(ValueError, match=r"expected the file that manifest\.json was written for"):
        open_exported(tmp_path)
    with pytest.raises(FileNotFoundError, match="expected one that export_policy wrote"):
        open_exported(tmp_path / "nowhere")
    with pytest.raises(ValueError, match=r"to: expected one of .* given 'tflite'"):
        export_policy(policy, tmp_path / "other", "tflite")


class Rows(GeometryTransform):
    """Half-spaces by unbinding, stacking and plain arithmetic, checked as a user's own are."""

    def constraint_set(self, tensordict: TensorDictBase) -> HalfSpaces:
        """Return five rows, of which two turn with the state."""
        x, y, *_ = torch.unbind(tensordict["observation"], -1)
        zero, one = torch.zeros_like(x), torch.ones_like(x)
        drift = 0.3 * (x - y)
        normals = [(one, zero), (-one, zero), (zero, 1 + y / 2), (zero, -one), (1 + x / 2, one)]
        offsets = [1 - drift, (1 + x) / 2 + 0.1, 0.5 * one, 1 - y, one + drift]
        rows = [torch.stack(normal, -1) for normal in normals]
        return HalfSpaces(torch.stack(rows, -2), torch.stack(offsets, -1))


@COMPILERS
def test_steps_inwards_and_sets_of_ones_own_are_exported_for_any_batch(tmp_path: Path) -> None:
    env = constrain_env(PointNavEnv([8], seed=0), Rows("rows", ["observation"]))
    actor = actor_for(env)
    policy = DeployedPolicy(actor, env, steps=1)
    export_policy(policy, tmp_path, "torch")
    run = open_exported(tmp_path)
    assert not run(*policy.examples(1))[0].requires_grad
    assert all(parameter.requires_grad for parameter in policy.parameters())
    for batch in (1, 2, 17, 300):
        states = observed_states(policy, env, actor, batch)
        found = self_test(policy, run, states)
        assert found["states"] == batch
        assert found["violations"] == found["fallback_out_of_bounds"] == 0
        assert found["certified"] >= 0.9 * batch
        assert found["largest_difference"] < 1e-5


@pytest.mark.slow
@COMPILERS
@pytest.mark.parametrize("to", FORMATS)
def test_every_format(to: str, env: TransformedEnv, tmp_path: Path) -> None:
    actor = actor_for(env)
    policy = DeployedPolicy(actor, env, stochastic=True)
    export_policy(policy, tmp_path, to)
    manifest = json.loads((tmp_path / "manifest.json").read_text())
    assert [constraint["name"] for constraint in manifest["constraints"]] == ["battery", "obstacle"]
    run = open_exported(tmp_path)
    states = observed_states(policy, env, actor, 100_000)
    found = self_test(policy, run, states)
    assert found["violations"] == found["fallback_out_of_bounds"] == 0
    assert found["certified"] > 95_000
    one = with_noise(policy, [value[:1] for value in states])
    assert latencies({"eager": policy, to: run}, one, rounds=5).keys() == {"eager", to}


@pytest.mark.slow
@COMPILERS
@pytest.mark.parametrize("name", DIMENSIONS)
def test_every_family_in_onnxruntime(name: str, tmp_path: Path) -> None:
    policy, inputs = policy_of(name, 100_000)
    export_policy(policy, tmp_path)
    found = self_test(policy, open_exported(tmp_path), inputs)
    assert found["states"] == 100_000
    assert found["violations"] == found["fallback_out_of_bounds"] == 0
    assert found["certified"] > 25_000
