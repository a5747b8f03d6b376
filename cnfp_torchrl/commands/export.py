"""Export a trained policy for a machine without PyTorch: the command ``cnfp-export``."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from cnfp_torchrl.commands.extras import needs_extra
from cnfp_torchrl.commands.run_options import FINISHED_RUN

with needs_extra("train"):
    import torch

    from cnfp_torchrl.commands.refusals import errors_in_a_sentence
    from cnfp_torchrl.deploy import FORMATS, DeployedPolicy, export_policy, open_exported
    from cnfp_torchrl.deploy.export import missing_packages, read_manifest, write_manifest
    from cnfp_torchrl.deploy.policy import STEPS
    from cnfp_torchrl.deploy.self_test import latencies, observed_states, self_test, with_noise
    from cnfp_torchrl.training.agent import build_environment, load_actor
    from cnfp_torchrl.training.run_folder import RunFolder


def export_run(
    folder: RunFolder,
    output: Path,
    *,
    to: str = "onnx",
    stochastic: bool = False,
    steps: int = STEPS,
    fallback: Sequence[float] | None = None,
    states: int = 10_000,
    seed: int = 0,
    trusted: Sequence[str] = (),
) -> dict[str, Any]:
    """Export the policy of a run, test what was written, and return the manifest.

    Args:
        folder: The folder of a finished run.
        output: The folder to write into.
        to: The format, see `cnfp_torchrl.deploy.export_policy`.
        stochastic: Whether the graph takes noise, see `cnfp_torchrl.deploy.DeployedPolicy`.
        steps: The number of steps inwards of the anchor's attempts.
        fallback: The action of states that are not certified; None takes the default.
        states: The number of states of the self-test.
        seed: The seed of the self-test.
        trusted: The packages that the run's configuration may name, see `RunFolder.load_config`.
    """
    if states < 1:
        raise ValueError(f"--states: expected a number >= 1, given {states}")
    torch.manual_seed(seed)
    config = folder.load_config(trusted)
    env = build_environment(config, batch_size=[64])
    env.set_seed(seed)
    actor = load_actor(folder, config, env)
    policy = DeployedPolicy(actor, env, stochastic=stochastic, steps=steps, fallback=fallback)
    visited = observed_states(policy, env, actor, states)
    export_policy(policy, output, to)  # type: ignore[arg-type]
    run = open_exported(output)
    state = with_noise(policy, [value[:1] for value in visited])
    manifest = {
        **read_manifest(output),
        "checkpoint": folder.checkpoint,
        "self_test": self_test(policy, run, visited),
        "milliseconds_for_one_state": latencies({"eager": policy, to: run}, state),
    }
    write_manifest(output, manifest)
    return manifest


def report(manifest: dict[str, Any], output: Path) -> str:
    """Return what the command prints."""
    test, taken = manifest["self_test"], manifest["milliseconds_for_one_state"]
    times = ", ".join(f"{name} {milliseconds:.2f} ms" for name, milliseconds in taken.items())
    return (
        f"certified {test['certified']} of {test['states']} states "
        f"({test['certified'] / test['states']:.2%}), {test['violations']} violations in them\n"
        f"largest difference from eager mode {test['largest_difference']:.1e}, otherwise certified "
        f"{test['certified_otherwise_in_eager']}; of eager mode where observations change in the "
        f"last bit {test['largest_change_in_the_last_bit']:.1e}\n"
        f"one state: {times}\n{output / manifest['file']}\n"
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Export, print what the self-test found, and exit with 3 if it found a violation."""
    parser = argparse.ArgumentParser(
        prog="cnfp-export",
        description="Export a trained policy as one graph, from the observation to the allowed "
        "action, with a manifest and a self-test.",
        parents=[FINISHED_RUN],
    )
    parser.add_argument("--to", choices=FORMATS, default="onnx", help="format (onnx)")
    parser.add_argument("--output", help="folder to write into (RUN/export)")
    parser.add_argument(
        "--stochastic", action="store_true", help="take noise as a last input, and sample"
    )
    parser.add_argument(
        "--steps", type=int, default=STEPS, help=f"inwards, to find an anchor ({STEPS})"
    )
    parser.add_argument(
        "--fallback",
        metavar="A1,A2,...",
        help="action of states that are not certified (the point with the most room)",
    )
    parser.add_argument("--states", type=int, default=10_000, help="of the self-test (10000)")
    parser.add_argument("--seed", type=int, default=0, help="of the self-test (0)")
    options = vars(parser.parse_args(arguments))
    if missing := missing_packages([options["to"]]):
        parser.exit(
            2,
            f"{parser.prog}: error: {' and '.join(missing)} not installed; install with: pip "
            "install 'cnfp_torchrl[export]'\n",
        )
    with errors_in_a_sentence(parser.prog, status=2):
        folder = RunFolder.open(options.pop("run"), options.pop("checkpoint"))
        output = Path(options.pop("output") or folder.path / "export")
        options["fallback"] = _numbers(options["fallback"])
        manifest = export_run(folder, output, **options)
    sys.stdout.write(report(manifest, output))
    if manifest["self_test"]["violations"]:
        sys.exit(3)


def _numbers(given: str | None) -> list[float] | None:
    if given is None:
        return None
    try:
        return [float(part) for part in given.split(",")]
    except ValueError:
        raise ValueError(
            f"--fallback: expected numbers separated by commas, given {given!r}"
        ) from None


if __name__ == "__main__":
    main()
