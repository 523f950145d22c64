from dataclasses import dataclass

import pytest
import torch
from torch import Tensor
from torch.utils import _pytree as pytree
from torch.utils.data import DataLoader, default_collate

from sdf.containers import Ragged, collate, container, detach, index, pad, stack


@container({"places": Ragged(-2), "weights": Ragged(-1, float("-inf")), "frames": Ragged(-2, None)}, data=("stamp",))
@dataclass(frozen=True)
class Held:
    places: Tensor
    weights: Tensor
    frames: Tensor
    shape: torch.nn.Module | None = None
    scale: float = 2.0
    stamp: float = 0.0
    more: Tensor | None = None

    def __post_init__(self):
        assert isinstance(self.places, Tensor), "refuses what is no tensor"


@dataclass
class Stranger:
    places: Tensor


def held(count, stamp=0.0, **changes):
    numbers = torch.arange(3.0 * count).reshape(count, 3)
    return Held(numbers, numbers[:, 0], numbers + 0.5, stamp=stamp, **changes)


def same(a, b):
    leaves = zip(pytree.tree_leaves(a), pytree.tree_leaves(b), strict=True)
    return all(torch.equal(torch.as_tensor(x), torch.as_tensor(y)) for x, y in leaves)


def test_leaves_are_tensors_and_named_numbers():
    assert [type(leaf).__name__ for leaf in pytree.tree_leaves(held(2))] == ["Tensor", "Tensor", "Tensor", "float"]
    shapes = pytree.tree_map_only(Tensor, lambda leaf: tuple(leaf.shape), held(2))
    assert shapes.places == (2, 3) and shapes.scale == 2.0 and shapes.more is None, "nothing is checked anew"
    assert same(held(2), pytree.tree_map(lambda leaf: leaf, held(2)))


def test_a_stack_has_the_items_as_rows():
    items = [held(2, stamp=float(k)) for k in range(3)]
    together = stack(items)
    assert together.places.shape == (3, 2, 3) and together.scale == 2.0
    assert together.stamp.tolist() == [0.0, 1.0, 2.0]
    for k, item in enumerate(items):
        assert same(index(together, k), item)
    assert index(together, torch.tensor([True, False, True])).places.shape == (2, 2, 3)


def test_padding_makes_the_items_as_long_as_the_longest():
    short, long = pad([held(1), held(3)])
    assert same(long, held(3))
    assert torch.equal(short.places[1:], torch.zeros(2, 3))
    assert torch.equal(short.weights[1:], torch.full((2,), float("-inf")))
    assert torch.equal(short.frames, held(1).frames.expand(3, 3)), "the last entry is repeated"
    empty, _ = pad([held(0), held(2)])
    assert torch.equal(empty.frames, torch.zeros(2, 3)), "of nothing there is no last entry"
    assert pad([]) == []


def test_collate_goes_into_tuples_and_mappings():
    batch = collate([{"x": (held(k), torch.tensor(k), None)} for k in (1, 2)])
    assert batch["x"][0].places.shape == (2, 2, 3)
    assert batch["x"][1].tolist() == [1, 2] and batch["x"][2] is None


def test_what_cannot_be_put_together_is_refused_with_its_name():
    with pytest.raises(ValueError, match="at least one item"):
        stack([])
    with pytest.raises(ValueError, match=r"item\.places to have one shape.*use collate"):
        stack([held(1), held(2)])
    with pytest.raises(ValueError, match=r"item\.more to be NoneType, got Tensor"):
        stack([held(1), held(1, more=torch.ones(1))])
    with pytest.raises(ValueError, match=r"item\.scale to be 2.0 in all.*shares its settings"):
        stack([held(1), held(1, scale=3.0)])
    with pytest.raises(ValueError, match=r"item\.shape to be one module"):
        stack([held(1, shape=torch.nn.Identity()), held(1, shape=torch.nn.Identity())])
    with pytest.raises(ValueError, match="registered container, got Stranger"):
        stack([Stranger(torch.ones(1))])
    with pytest.raises(ValueError, match="same names"):
        collate([{"a": torch.ones(1)}, {"b": torch.ones(1)}])


def test_a_module_is_shared():
    module = torch.nn.Identity()
    assert collate([held(1, shape=module), held(2, shape=module)]).shape is module


def test_detach_keeps_the_numbers():
    held_ = held(2)
    held_.places.requires_grad_()
    assert detach(held_).places.requires_grad is False and same(detach(held_), held_)


def test_vmap_and_loaders_take_it():
    batch = stack([held(2, stamp=float(k)) for k in range(3)])
    found = torch.func.vmap(lambda one: one.places.sum() + one.stamp)(batch)
    assert torch.equal(found, 15.0 + torch.arange(3.0))
    assert default_collate([held(1), held(2)]).places.shape == (2, 2, 3)
    loaded = next(iter(DataLoader([held(1), held(2)], batch_size=2)))
    assert isinstance(loaded, Held) and loaded.places.shape == (2, 2, 3)
