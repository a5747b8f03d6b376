import itertools

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import QuotedString
from omegaconf import OmegaConf

from cnfp_torchrl.commands.paths import quoted_paths

# What Hydra's grammar and OmegaConf's interpolation take for something else, in all orders.
ODD = ["a", "\\", "'", '"', "$", "{", "}", "=", ",", "[", "]", " ", "(", ":", "%", "~", "ü"]


def read(argument: str) -> str:
    value = OverridesParser.create().parse_override(argument).value()
    text = value.text if isinstance(value, QuotedString) else value
    return str(OmegaConf.create({"run": text}).run)


@pytest.mark.parametrize("length", [1, 2, 3])
def test_every_path_arrives_as_it_is(length: int) -> None:
    for characters in itertools.product(ODD if length < 3 else ODD[:7], repeat=length):
        path = "x/" + "".join(characters)
        (argument,) = quoted_paths([f"run={path}"])
        assert read(argument) == path


def test_other_arguments_and_quoted_paths_stay() -> None:
    arguments = ["seed=1", "-m", "run='a=b'", "run=null", "run=", "env.order=[a,b]", "runs=a=b"]
    assert quoted_paths(arguments) == arguments


def test_no_folder_is_made_for_a_run_that_is_not_there() -> None:
    with pytest.raises(SystemExit, match="nowhere, which is none"):
        quoted_paths(["resume=nowhere"])
