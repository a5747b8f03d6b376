"""One constraint alone: reading its geometry, pushing samples, and the order of several."""

import re
from collections.abc import Sequence

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torch.distributions import Independent, Normal

from cnfp_torchrl.bijectors import SquashChain
from cnfp_torchrl.distributions import ConstrainedFlow
from cnfp_torchrl.geometry import Ball, Box, ConstraintSet, Ellipsoid, HalfSpaces
from cnfp_torchrl.modules import ConstraintBijector, in_order

BATCH, DIM = 5, 3

GEOMETRIES: dict[type[ConstraintSet], dict[str, Tensor]] = {
    Box: {"low": torch.full((BATCH, DIM), -0.5), "high": torch.full((BATCH, DIM), 0.75)},
    Ball: {"center": torch.full((BATCH, DIM), 0.2), "radius": torch.full((BATCH,), 0.6)},
    Ellipsoid: {
        "center": torch.full((BATCH, DIM), 0.1),
        "scale_tril": torch.diag(torch.tensor([0.5, 1.0, 0.25])).expand(BATCH, DIM, DIM),
    },
}
FAMILIES = pytest.mark.parametrize("family", GEOMETRIES, ids=lambda family: family.__name__)


def published(**sets: type[ConstraintSet]) -> TensorDict:
    geometry = {name: GEOMETRIES[family] for name, family in sets.items()}
    return TensorDict({"constraints": geometry}, batch_size=[BATCH]).double()


@FAMILIES
def test_get_set_reads_the_published_fields(family: type[ConstraintSet]) -> None:
    state = published(limit=family)
    read = ConstraintBijector("limit", family).get_set(state)
    assert type(read) is family
    for field, value in read.fields().items():
        assert value is state["constraints", "limit", field]


@FAMILIES
def test_get_transform_maps_onto_the_set(family: type[ConstraintSet]) -> None:
    state = published(limit=family)
    bijector = ConstraintBijector("limit", family)
    latent = 10 * torch.randn(BATCH, DIM, dtype=torch.float64)
    action = bijector.get_transform(state)(latent)
    assert bijector.get_set(state).contains(action).all()


@FAMILIES
def test_forward_alone_is_the_squash_and_its_log_determinant(family: type[ConstraintSet]) -> None:
    state = published(limit=family)
    latent = torch.randn(BATCH, DIM, dtype=torch.float64)
    out = ConstraintBijector("limit", family)(state.set("action", latent))
    for i in range(BATCH):
        transform = ConstraintBijector("limit", family).get_transform(state[i])
        jacobian = torch.autograd.functional.jacobian(transform, latent[i])
        torch.testing.assert_close(out["log_det"][i], jacobian.slogdet().logabsdet)
        torch.testing.assert_close(out["action"][i], transform(latent[i]))


@pytest.mark.parametrize("keys", [("action", "log_det"), (("agent", "move"), ("agent", "log_det"))])
def test_chained_modules_score_as_the_distribution_of_the_chain(keys: tuple[str, str]) -> None:
    sample_key, log_det_key = keys
    names = {"soft": Ellipsoid, "middle": Ball, "hard": Box}
    modules = [
        ConstraintBijector(name, family, sample_key=sample_key, log_det_key=log_det_key)
        for name, family in names.items()
    ]
    state = published(**names)
    latent = torch.randn(BATCH, DIM, dtype=torch.float64)
    base = Independent(Normal(torch.zeros_like(latent), torch.ones_like(latent)), 1)
    flow = ConstrainedFlow(base, SquashChain([module.get_transform(state) for module in modules]))

    state[sample_key] = latent
    for module in modules:
        state = module(state)

    scored = base.log_prob(latent) - state[log_det_key]
    torch.testing.assert_close(state[sample_key], flow.bijector(latent))
    torch.testing.assert_close(scored, flow.log_prob(state[sample_key]))


def test_declared_keys_are_those_that_are_used() -> None:
    bijector = ConstraintBijector("limit", Ball)
    state = published(limit=Ball, other=Box).set("action", torch.zeros(BATCH, DIM).double())
    out = bijector(state.select(*bijector.in_keys))
    assert set(bijector.out_keys) == {"action", "log_det"}
    assert set(out.keys()) == {"constraints", *bijector.out_keys}


@FAMILIES
def test_missing_geometry_is_named(family: type[ConstraintSet]) -> None:
    bijector = ConstraintBijector("limit", family)
    for key in bijector.geometry_keys:
        message = re.escape(f"expected {key}, found keys [") + ".*publishes constraint 'limit'$"
        with pytest.raises(KeyError, match=message):
            bijector.get_set(published(limit=family, other=Box).exclude(key))


@pytest.mark.parametrize("wrong", ["Ball", Ball(torch.zeros(2), torch.tensor(1.0)), dict])
def test_a_set_type_that_is_no_family_is_refused(wrong: object) -> None:
    with pytest.raises(TypeError, match="set_type of constraint 'limit': expected a subclass"):
        ConstraintBijector("limit", wrong)  # type: ignore[arg-type]


def test_a_family_without_a_squash_can_be_read_but_not_pushed_through() -> None:
    geometry = {"normals": torch.eye(2).expand(BATCH, 2, 2), "offsets": torch.ones(BATCH, 2)}
    state = TensorDict({"constraints": {"limit": geometry}}, batch_size=[BATCH])
    bijector = ConstraintBijector("limit", HalfSpaces)
    assert isinstance(bijector.get_set(state), HalfSpaces)
    with pytest.raises(TypeError, match=r"given HalfSpaces; use the exact flow"):
        bijector.get_transform(state)


# Order ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("order", [None, ["a", "b", "c"], ["c", "a", "b"], ("b", "c", "a")])
def test_order_is_that_of_the_names(order: Sequence[str] | None) -> None:
    bijectors = [ConstraintBijector(name, Box) for name in "abc"]
    names = [bijector.name for bijector in in_order(bijectors, order)]
    assert names == list(order or "abc")
    assert set(in_order(bijectors, order)) == set(bijectors)


@pytest.mark.parametrize(
    ("names", "order"),
    [
        pytest.param("abc", ["a", "b", "d"], id="unknown name"),
        pytest.param("abc", ["a", "b"], id="missing name"),
        pytest.param("abc", [], id="empty order"),
        pytest.param("abc", ["a", "b", "c", "a"], id="repeated in the order"),
        pytest.param("abc", ["a", "b", "b"], id="repeated in place of another"),
        pytest.param("", ["a"], id="no constraints"),
    ],
)
def test_an_order_that_does_not_name_each_constraint_once_is_refused(
    names: str, order: list[str] | None
) -> None:
    given = re.escape(str(list(names) if order is None else order))
    expected = re.escape(str(list(names)))
    with pytest.raises(ValueError, match=f"order: .*{expected} exactly once, given {given}"):
        in_order([ConstraintBijector(name, Box) for name in names], order)


@pytest.mark.parametrize("order", [None, ["a", "b"]], ids=str)
def test_two_constraints_of_one_name_are_refused_by_that_name(order: list[str] | None) -> None:
    with pytest.raises(ValueError, match=r"names: .* given \['a'\] more than once"):
        in_order([ConstraintBijector(name, Box) for name in "aab"], order)


def test_a_string_is_no_order() -> None:
    # The letters of "ab" would be an order of these two.
    bijectors = [ConstraintBijector(name, Box) for name in "ab"]
    with pytest.raises(TypeError, match=r"order: .*given the string 'ab'; write order=\['ab'\]"):
        in_order(bijectors, "ab")


@pytest.mark.parametrize("wrong", ["a", [ConstraintBijector("a", Box)], Box])
def test_what_is_no_bijector_has_no_place_in_an_order(wrong: object) -> None:
    with pytest.raises(TypeError, match="bijectors: expected a sequence of ConstraintBijector"):
        in_order([ConstraintBijector("b", Box), wrong], None)  # type: ignore[list-item]
