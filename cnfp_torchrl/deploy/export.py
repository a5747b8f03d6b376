"""Files of a deployed policy, with a manifest that says all that is needed to run them."""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal, get_args

import torch
from tensordict.utils import NestedKey
from torch import Tensor
from torch.export import Dim, ExportedProgram

from cnfp_torchrl.deploy.notices import without_exporters_notices
from cnfp_torchrl.deploy.operators import OperatorsOfOnnx
from cnfp_torchrl.deploy.policy import DeployedPolicy
from cnfp_torchrl.installed_versions import installed_versions
from cnfp_torchrl.whole_file import write_json

Format = Literal["onnx", "torch", "aoti"]
FORMATS: tuple[Format, ...] = get_args(Format)
"""ONNX, `torch.export`, and AOTInductor, which compiles for the processor at hand."""

FILES: dict[Format, str] = {"onnx": "policy.onnx", "torch": "policy.pt2", "aoti": "policy.aoti.pt2"}
MANIFEST = "manifest.json"
OUTPUTS = ("action", "certified")
NOISE = "noise"

Run = Callable[..., tuple[Tensor, Tensor]]
"""Inputs ``(B, *event)`` in the manifest's order to actions ``(B, d)`` and flags ``(B,)``."""

_PACKAGES = ("cnfp_torchrl", "torch", "torchrl", "tensordict", "onnx", "onnxscript", "onnxruntime")


def export_policy(policy: DeployedPolicy, folder: str | Path, to: Format = "onnx") -> Path:
    """Write a policy's file and manifest into a folder, and return the file's path.

    Args:
        policy: The policy.
        folder: The folder, made if need be.
        to: The format of the file.

    Raises:
        ValueError: for an unknown format.
        FileExistsError: when the folder holds such a file or a manifest already.
        ModuleNotFoundError: for ``onnx`` without the packages of the extra ``export``.
    """
    if to not in FORMATS:
        raise ValueError(f"to: expected one of {list(FORMATS)}, given {to!r}")
    folder = Path(folder)
    file = folder / FILES[to]
    if held := [path.name for path in (file, folder / MANIFEST) if path.exists()]:
        raise FileExistsError(
            f"folder: expected one without {held}, given {folder}; nothing is overwritten"
        )
    folder.mkdir(parents=True, exist_ok=True)
    with without_exporters_notices(), _frozen(policy):
        if to == "onnx":
            _write_onnx(policy, file)
        elif to == "torch":
            torch.export.save(_program(policy), file)
        else:
            torch._inductor.aoti_compile_and_package(_program(policy), package_path=str(file))
    write_manifest(folder, _manifest(policy, file, to))
    return file


@contextmanager
def _frozen(policy: DeployedPolicy) -> Iterator[None]:
    """Let parameters ask for no gradients, for a loaded program gives actions as it was written."""
    asked = [parameter for parameter in policy.parameters() if parameter.requires_grad]
    for parameter in asked:
        parameter.requires_grad_(False)
    try:
        yield
    finally:
        for parameter in asked:
            parameter.requires_grad_(True)


def write_manifest(folder: Path, manifest: dict[str, Any]) -> None:
    """Write a manifest."""
    write_json(folder / MANIFEST, manifest)


def read_manifest(folder: str | Path) -> dict[str, Any]:
    """Read the manifest of an exported policy.

    Raises:
        FileNotFoundError: when there is none.
    """
    path = Path(folder) / MANIFEST
    if not path.is_file():
        raise FileNotFoundError(f"folder: expected one that export_policy wrote, lacks {path}")
    manifest: dict[str, Any] = json.loads(path.read_text())
    return manifest


def open_exported(folder: str | Path) -> Run:
    """Return an exported policy as a function of tensors.

    Raises:
        FileNotFoundError: when the folder lacks its manifest.
        ValueError: when the file is not the one that the manifest was written for.
    """
    manifest = read_manifest(folder)
    path = Path(folder) / manifest["file"]
    if _digest(path) != manifest["sha256"]:
        raise ValueError(
            f"{path}: expected the file that {MANIFEST} was written for, given another; copy both "
            "anew, or export again"
        )
    if manifest["format"] == "onnx":
        return _open_onnx(path)
    if manifest["format"] == "torch":
        loaded: Run = torch.export.load(path).module()
        return loaded
    compiled: Run = torch._inductor.aoti_load_package(str(path))
    return compiled


def _open_onnx(path: Path) -> Run:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.log_severity_level = 3  # it warns of constants that it does not fold
    session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    names = [tensor.name for tensor in session.get_inputs()]

    def run(*inputs: Tensor) -> tuple[Tensor, Tensor]:
        given = {name: tensor.numpy() for name, tensor in zip(names, inputs, strict=True)}
        action, certified = session.run(list(OUTPUTS), given)
        return torch.from_numpy(action), torch.from_numpy(certified)

    return run


def _program(policy: DeployedPolicy) -> ExportedProgram:
    """Return a policy as a program for any batch size."""
    # Not a size that is also one of its dimensions, with which the batch would be mistaken.
    batch = Dim("batch", min=1)
    inputs = policy.examples(17)
    shapes = (tuple({0: batch} for _ in inputs),)
    with torch.no_grad():
        return torch.export.export(policy, inputs, dynamic_shapes=shapes, strict=False)


def _write_onnx(policy: DeployedPolicy, file: Path) -> None:
    try:
        import onnxscript  # noqa: F401 - what torch.onnx needs
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            "to='onnx' needs onnxscript; install it with: pip install 'cnfp_torchrl[export]'",
            name=error.name,
        ) from error
    with OperatorsOfOnnx():
        program = _program(policy)
    exported = torch.onnx.export(
        program,
        dynamo=True,
        optimize=False,  # onnxruntime does, when it loads the file
        verbose=False,
        input_names=input_names(policy),
        output_names=list(OUTPUTS),
    )
    assert exported is not None
    exported.save(file, external_data=False)


def input_names(policy: DeployedPolicy) -> list[str]:
    """Return the names of a policy's inputs, in order."""
    names = [_name(key) for key in policy.input_keys]
    return [*names, NOISE] if policy.stochastic else names


def _name(key: NestedKey) -> str:
    return key if isinstance(key, str) else ".".join(key)


def _manifest(policy: DeployedPolicy, file: Path, to: Format) -> dict[str, Any]:
    bounds = policy.bounds.on(None)
    inputs = [
        {"name": name, "dtype": _dtype(example), "shape": ["batch", *example.shape[1:]]}
        for name, example in zip(input_names(policy), policy.examples(1), strict=True)
    ]
    if policy.stochastic:
        inputs[-1]["distribution"] = "independent standard normal"
    fallback = "the point with the most room in all sets that was tried, within the action bounds"
    return {
        "format": to,
        "file": file.name,
        "sha256": _digest(file),
        "inputs": inputs,
        "outputs": [
            {"name": "action", "dtype": _dtype(bounds.low), "shape": ["batch", bounds.dim]},
            {"name": "certified", "dtype": "bool", "shape": ["batch"]},
        ],
        "action_bounds": {"low": bounds.low.tolist(), "high": bounds.high.tolist()},
        "units": "those of the environment's own observations and actions; nothing is rescaled",
        "constraints": [
            {"name": bijector.name, "family": bijector.set_type.__name__}
            for bijector in policy.bijectors
        ],
        "priority": "the last constraint has the highest; a state in which not all hold together "
        "is not certified",
        "flow": type(policy.flow).__name__,
        "policy": "stochastic" if policy.stochastic else "deterministic",
        "steps": policy.steps,
        "fallback": fallback if policy.fallback is None else policy.fallback.tolist(),
        "versions": {"python": platform.python_version(), **installed_versions(_PACKAGES)},
    }


def _dtype(value: Tensor) -> str:
    return str(value.dtype).removeprefix("torch.")


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def missing_packages(to: Sequence[str]) -> list[str]:
    """Return what formats need and is not installed."""
    needed = ["onnxscript", "onnxruntime"] if "onnx" in to else []
    installed = installed_versions(needed)
    return [package for package in needed if package not in installed]
