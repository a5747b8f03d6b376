"""Text tables are aligned, and end in no blanks."""

import pytest

from cnfp_torchrl.text_table import text_table


def test_columns_begin_below_each_other() -> None:
    rows = [("name", "n", "note"), ("a longer name", "1,000", ""), ("b", "", "x y")]
    lines = text_table(rows).split("\n")
    assert [line.split() for line in lines] == [" ".join(row).split() for row in rows]
    assert lines[0].index("note") == lines[2].index("x y")
    assert not [line for line in lines if line.endswith(" ")]


def test_rows_of_other_lengths_are_refused() -> None:
    with pytest.raises(ValueError, match="argument 2 is shorter"):
        text_table([("a", "b"), ("c",)])
