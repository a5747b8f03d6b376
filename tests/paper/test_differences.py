"""Configurations of runs, compared setting by setting."""

from experiments.paper.differences import differences, in_words

USUAL = {"flow": {"_target_": "package.Exact", "order": ["a", "b"]}, "penalty": None, "lr": 0.1}


def test_differences_name_both_values_and_what_is_absent() -> None:
    other = {"flow": {"_target_": "package.Exact", "order": ["b", "a"]}, "penalty": None, "new": {}}
    assert differences(USUAL, other) == {
        "flow.order": ('["a", "b"]', '["b", "a"]'),
        "lr": ("0.1", "absent"),
        "new": ("absent", "{}"),
    }
    assert differences(USUAL, USUAL) == {}


def test_words_are_those_of_the_special_configuration() -> None:
    assert in_words(USUAL, USUAL) == "nothing"
    special = {
        "flow": {"_target_": "package.module.Other", "order": ["a", "b"]},
        "penalty": {"_target_": "package.Penalty", "penalty": 100.0},
    }
    assert in_words(USUAL, special) == (
        "`flow: Other`, `lr: absent`, `penalty: Penalty`, `penalty.penalty: 100.0`"
    )
