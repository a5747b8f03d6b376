"""``cnfp-explain`` on a real run."""

import re
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from cnfp_torchrl.commands.explain import explain_run, main
from cnfp_torchrl.configuration import compose_config
from cnfp_torchrl.training.agent import build_environment, load_actor
from cnfp_torchrl.training.episodes import record_episode
from cnfp_torchrl.training.run_folder import BEST, CHECKPOINT, RunFolder
from cnfp_torchrl.training.settings import EvaluationSettings
from cnfp_torchrl.training.train import train

TINY = [
    "collector.total_frames=64",
    "training.warmup_frames=64",
    "training.update_ratio=0.05",
    "evaluation.episodes=3",
    "+env.base.max_steps=8",
    "logger=none",
]


@pytest.fixture(scope="module")
def make_run(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., RunFolder]:
    made: dict[tuple[str, ...], RunFolder] = {}

    def make(*overrides: str) -> RunFolder:
        if overrides not in made:
            folder = RunFolder.create(tmp_path_factory.mktemp("run"))
            train(compose_config(*TINY, *overrides), folder)
            made[overrides] = folder
        return made[overrides]

    return make


@pytest.mark.parametrize("flow", ["exact", "radial", "squash", "unconstrained"])
def test_every_flow_is_explained(flow: str, make_run: Callable[..., RunFolder]) -> None:
    text = explain_run(make_run(f"flow={flow}"), step=2)
    assert text.startswith("Step 2 of 8, episode 0, seed 1000, stochastic policy\n")
    for words in ("battery constraint", "obstacle constraint", "goal x", "Reward "):
        assert words in text
    assert "steps are left above 20 %" in text.replace("\n", " ")
    assert max(map(len, text.splitlines())) <= 100
    for table in (
        explain_run(make_run(f"flow={flow}")),
        explain_run(make_run(f"flow={flow}"), every_step=True),
    ):
        assert max(map(len, table.splitlines())) <= 100
    assert [int(line.split()[0]) for line in table.splitlines()[3:11]] == list(range(8))


@pytest.mark.parametrize("deterministic", [False, True])
def test_the_step_is_that_of_the_episode(
    deterministic: bool, make_run: Callable[..., RunFolder]
) -> None:
    folder = make_run("flow=exact")
    said = explain_run(folder, step=5, episode=2, seed=11, deterministic=deterministic)
    config = folder.load_config()
    env = build_environment(config, batch_size=[1], with_anchor=True)
    actor = load_actor(folder, config, env)
    settings = EvaluationSettings(seed=11)
    steps = record_episode(env, actor, settings, 2, deterministic=deterministic)
    x, y, *_ = steps[5]["observation"].tolist()
    assert f"At ({x:.3f}, {y:.3f})" in said
    for name, value in zip(("right", "up"), steps[5]["action"].tolist(), strict=True):
        assert re.search(rf"^{name} .* {re.escape(f'{value:.3f}')}$", said, re.MULTILINE)
    assert f"Reward {float(steps[5]['next', 'reward']):.3f}" in said


def test_the_command_prints_it(
    make_run: Callable[..., RunFolder], capsys: pytest.CaptureFixture[str]
) -> None:
    folder = make_run("flow=exact")
    main([str(folder.path), "--step", "7", "--episode", "1"])
    assert capsys.readouterr().out == explain_run(folder, step=7, episode=1)


def test_the_best_policy_is_explained_where_it_is_asked_for(
    make_run: Callable[..., RunFolder], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = shutil.copytree(make_run("flow=exact").path, tmp_path / "run")
    shutil.copy(make_run("flow=exact", "seed=1").path / CHECKPOINT, run / BEST)
    main([str(run), "--step", "7", "--checkpoint", BEST])
    title, _, best = capsys.readouterr().out.partition("\n")
    assert title.endswith("stochastic policy of best.pt")
    for seed, same in ((0, False), (1, True)):
        folder = make_run("flow=exact", *(["seed=1"] if seed else []))
        assert (explain_run(folder, step=7).partition("\n")[2] == best) is same


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--checkpoint", "state.pt"], "checkpoint: expected checkpoint.pt, the last policy, or"),
        (["--step", "8"], "--step: expected a number from 0 to 7, the last of episode 0, given 8"),
        (["--step", "-1"], "--step: expected a number >= 0, given -1"),
        (["--step", "0", "--episode", "-1"], "--episode: expected a number >= 0, given -1"),
        (["--step", "few"], "invalid int value: 'few'"),
        (["--step", "1", "--all"], "not allowed with"),
    ],
)
def test_wrong_input_is_explained(
    arguments: list[str],
    message: str,
    make_run: Callable[..., RunFolder],
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(SystemExit) as ended:
        main([str(make_run("flow=exact").path), *arguments])
    assert ended.value.code == 2
    assert message in capsys.readouterr().err


def test_a_missing_run_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main([str(tmp_path / "absent"), "--step", "0"])
    assert ended.value.code == 2
    assert f"{tmp_path / 'absent'} lacks" in capsys.readouterr().err
