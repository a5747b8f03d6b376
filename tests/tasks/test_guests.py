"""Tasks are guests: outside their own room nobody knows what they are about."""

import re
from pathlib import Path

import cnfp_torchrl

PACKAGE = Path(cnfp_torchrl.__file__).parent
OTHERS = [path for path in PACKAGE.rglob("*.py") if path.relative_to(PACKAGE).parts[0] != "tasks"]
WORDS = re.compile("battery|obstacle|station(?!ar)|point_?nav", re.IGNORECASE)


def test_no_other_room_knows_the_words_of_a_task() -> None:
    assert len(OTHERS) > 50
    found = [
        f"{path.relative_to(PACKAGE)}:{number}: {line.strip()}"
        for path in OTHERS
        for number, line in enumerate(path.read_text().splitlines(), 1)
        if WORDS.search(line)
    ]
    assert not found
