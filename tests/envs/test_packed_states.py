"""States kept once in a replay buffer: whatever is sampled is what was stored."""

from collections.abc import Iterator, Sequence

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

from cnfp_torchrl.envs import PackedStates
from cnfp_torchrl.envs.packed_states import POINTER_BYTES

KEYS = [("constraints", "a", "low"), ("constraints", "a", "active"), ("constraints", "point"), "x"]


def states(numbers: torch.Tensor) -> TensorDict:
    """Entries of several dtypes and shapes, all told by a number."""
    base = numbers.double()
    return TensorDict(
        {
            "constraints": {
                "a": {
                    "low": (base.unsqueeze(-1) + torch.tensor([0.0, 0.5])).float(),
                    "active": numbers % 3 == 0,
                },
                "point": base[:, None, None] * torch.tensor([[1.0, 2.0, 3.0]]).double(),
            },
            "x": numbers.to(torch.int16),
        },
        numbers.shape,
    )


def transitions(roots: torch.Tensor, afters: torch.Tensor) -> TensorDict:
    data = states(roots)
    data["next"] = states(afters)
    data["number"], data["next", "number"] = roots, afters
    return data


def stream(agents: int, steps: int, length: int, *, horizon: int = 1) -> Iterator[TensorDictBase]:
    """Batches ``(agents * horizon,)`` of agents whose episodes end at different times."""
    generator = torch.Generator().manual_seed(0)
    fresh = iter(range(1, 10**6))
    now = torch.tensor([next(fresh) for _ in range(agents)])
    for _ in range(steps):
        columns = []
        for _ in range(horizon):
            after = torch.tensor([next(fresh) for _ in range(agents)])
            columns.append((now, after))
            ended = torch.rand(agents, generator=generator) < 1 / length
            start = torch.tensor([next(fresh) for _ in range(agents)])
            now = torch.where(ended, start, after)
        roots, afters = (torch.stack(row, -1).flatten() for row in zip(*columns, strict=True))
        yield transitions(roots, afters)


def filled(
    batches: Iterator[TensorDictBase], size: int, rare: Sequence[NestedKey] = ()
) -> tuple[TensorDictReplayBuffer, int]:
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(size), batch_size=512)
    buffer.append_transform(PackedStates(KEYS, size, rare))
    count = 0
    for batch in batches:
        buffer.extend(batch)
        count += len(batch)
        assert_right(buffer)
    return buffer, count


def assert_right(buffer: TensorDictReplayBuffer) -> None:
    sample = buffer.sample()
    for part, numbers in ((sample, sample["number"]), (sample["next"], sample["next", "number"])):
        expected = states(numbers)
        for key in KEYS:
            assert part[key].dtype == expected[key].dtype
            assert torch.equal(part[key], expected[key]), key


@pytest.mark.parametrize("length", [1, 3, 50])
@pytest.mark.parametrize(
    ("agents", "size", "horizon"),
    [(4, 64, 1), (4, 64, 5), (1, 10, 1), (1, 10, 5), (7, 50, 5), (16, 16, 1), (16, 10_000, 5)],
)
def test_samples_are_what_was_stored(agents: int, size: int, length: int, horizon: int) -> None:
    filled(stream(agents, 60, length, horizon=horizon), size)


AMOUNTS = [("constraints", "a", "low"), ("constraints", "point")]


def seldom(batches: Iterator[TensorDictBase], every: int) -> Iterator[TensorDictBase]:
    """Set entries to zero in most states, all but every so many; 0 means in all."""
    for batch in batches:
        for part in (batch, batch["next"]):
            zero = part["number"] % every != 0 if every else torch.ones(len(part)).bool()
            for key in AMOUNTS:
                part[key] = part[key].masked_fill(zero.view(-1, *[1] * (part[key].ndim - 1)), 0)
        yield batch


@pytest.mark.parametrize("every", [0, 1, 7])
@pytest.mark.parametrize("keys", [AMOUNTS, AMOUNTS[1:]])
@pytest.mark.parametrize(("agents", "size", "horizon"), [(4, 64, 1), (7, 50, 5), (1, 10, 1)])
def test_rare_entries_are_what_was_stored(
    every: int, keys: list[NestedKey], agents: int, size: int, horizon: int
) -> None:
    batches = list(seldom(stream(agents, 60, 5, horizon=horizon), every))
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(size), batch_size=512)
    buffer.append_transform(PackedStates(KEYS, size, keys))
    given = torch.cat([part.select(*KEYS, "number") for b in batches for part in (b, b["next"])])
    row_of = {number: row for row, number in enumerate(given["number"].tolist())}
    for batch in batches:
        buffer.extend(batch)
    sample = buffer.sample()
    for part in (sample, sample["next"]):
        expected = given[[row_of[number] for number in part["number"].tolist()]]
        for key in KEYS:
            assert torch.equal(part[key], expected[key])
    packed = buffer._transform[0]
    if every == 0:
        assert packed._rare.end == 0
    # Of states that are dropped nothing is kept, whatever the length of the run.
    assert packed._rare.rows is None or len(packed._rare.rows) <= 8 * (size + agents * horizon)


@pytest.mark.parametrize("rare", [[], [("constraints", "a", "low")]])
@pytest.mark.parametrize("index", [3, slice(1, 4), torch.arange(6).view(2, 3), torch.arange(0)])
def test_transitions_are_looked_up_in_any_shape(
    index: int | slice | torch.Tensor, rare: Sequence[NestedKey]
) -> None:
    buffer, _ = filled(stream(10, 1, 4), 100, rare)
    stored = next(stream(10, 1, 4))
    given, expected = (td[index] for td in (buffer, stored))
    torch.testing.assert_close(
        given.select(*expected.keys(True, True)).to_dict(), expected.to_dict(), rtol=0, atol=0
    )


def test_batches_of_other_sizes_and_in_another_order_are_right() -> None:
    generator = torch.Generator().manual_seed(1)
    batches = [
        constraint_set[
            torch.randperm(len(constraint_set), generator=generator)[
                : 1 + index % len(constraint_set)
            ]
        ]
        for index, constraint_set in enumerate(stream(6, 40, 5))
    ]
    filled(iter(batches), 64)


@pytest.mark.parametrize("horizon", [1, 5])
def test_a_state_is_stored_once(horizon: int) -> None:
    buffer, count = filled(stream(16, 100, 50, horizon=horizon), 10_000)
    packed = buffer._transform[0]
    row = packed._states.rows.shape[-1]
    # Two percent for the first states of episodes, and the first column of a batch of several.
    assert packed.nbytes / row <= 1.05 * count * (1 if horizon == 1 else 1.2)
    stored = buffer.storage.get(range(len(buffer)))
    pointers = [value.nbytes for value in stored["state"].values()]
    assert sum(pointers) == POINTER_BYTES * count
    assert not set(KEYS) & set(stored.keys(True, True))


def test_states_that_nothing_refers_to_are_dropped() -> None:
    buffer, _ = filled(stream(8, 400, 20), 128)
    packed = buffer._transform[0]
    assert packed.nbytes / packed._states.rows.shape[-1] <= 1.3 * (128 + 2 * 8)


def test_it_is_saved_and_loaded() -> None:
    first, _ = filled(stream(4, 30, 5), 64)
    second, _ = filled(stream(4, 2, 5), 64)
    second.load_state_dict(first.state_dict())
    assert_right(second)
    assert sorted(second.storage.get(range(64))["number"].tolist()) == sorted(
        first.storage.get(range(64))["number"].tolist()
    )


def test_another_dtype_is_refused() -> None:
    buffer, _ = filled(stream(4, 2, 5), 64)
    batch = next(stream(4, 1, 5))
    batch["x"] = batch["x"].float()
    with pytest.raises(ValueError, match=r"key 'x': expected torch.int16.*given torch.float32"):
        buffer.extend(batch)
