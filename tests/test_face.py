"""The face of the package: what it offers, what it costs, and that nobody goes round it."""

import ast
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import cnfp_torchrl

PACKAGE = Path(cnfp_torchrl.__file__).parent
CORE = ["keys", "geometry", "bijectors", "distributions", "modules", "envs"]
OF_EXTRAS = {
    "PIL",
    "hydra",
    "matplotlib",
    "omegaconf",
    "psutil",
    "pyarrow",
    "rerun",
    "tensorboard",
    "tqdm",
    "yaml",
}
# What our dependencies bring by themselves is none of our doing.
DEPENDENCIES = "gymnasium, numpy, tensordict.nn, torch, torchrl.data, torchrl.envs, torchrl.modules"


def imported(*statements: str) -> list[set[str]]:
    """Return the packages that each of some statements brings into a fresh process, in turn."""
    told = "print(*sys.modules)\n"
    code = f"import sys, {DEPENDENCIES}\n{told}" + "".join(f"{s}\n{told}" for s in statements)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    packages = [{n.partition(".")[0] for n in names.split()} for names in done.stdout.splitlines()]
    return [after - before for before, after in pairwise(packages)]


def test_the_face_has_what_most_users_need_and_nothing_else() -> None:
    public = {name for name in cnfp_torchrl.__all__ if name != "__version__"}
    assert {"constrain", "constrain_env", "make_constrained_actor"} <= public
    assert {"GeometryTransform", "ConstrainedFlow", "ActionGuard", "SafeRandomPolicy"} <= public
    from cnfp_torchrl import geometry

    families = {
        name
        for name, value in vars(geometry).items()
        if isinstance(value, type) and issubclass(value, geometry.ConstraintSet)
    }
    assert {"Ball", "Box", "HalfSpaces", "WeightedL1Ball"} <= families & public
    for name in public:
        assert getattr(cnfp_torchrl, name).__doc__, name


def test_rooms_bring_in_no_package_that_they_do_not_use() -> None:
    rooms = ", ".join(f"cnfp_torchrl.{room}" for room in CORE)
    of_core, of_task, _, of_visual, of_rerun = imported(
        f"import cnfp_torchrl, {rooms}",
        "from cnfp_torchrl.tasks.point_nav import PointNavEnv, BatteryGeometry",
        # Where Ray is installed TorchRL imports it, and with it psutil and pyarrow.
        "import torchrl.collectors",
        "import cnfp_torchrl.visual",
        "import cnfp_torchrl.visual.rerun",
    )
    assert not (of_core | of_task) & OF_EXTRAS
    assert not of_visual & {"rerun", "matplotlib", "hydra", "psutil", "pyarrow"}
    assert "rerun" in of_rerun
    assert not of_rerun & {"matplotlib", "hydra", "omegaconf"}


def test_no_file_imports_private_names() -> None:
    private = [
        f"{file.name}: {node.module}.{alias.name}"
        for file in PACKAGE.rglob("*.py")
        for node in ast.walk(ast.parse(file.read_text()))
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("cnfp_torchrl")
        for alias in node.names
        if alias.name.startswith("_") or "._" in (node.module or "")
    ]
    assert not private
