"""Containers of tensors for learning code: dataclasses as pytrees, with stack, join, pad, index, detach, collate.

A registered dataclass goes through `torch.func.vmap`, `torch.utils._pytree` and a `DataLoader` as a tuple of tensors
does: its tensors, and what of its fields is named as data, are leaves; modules and settings go along as they are.
"""

from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import fields, is_dataclass
from typing import Any, NamedTuple, TypeVar, cast

import torch
from torch import Tensor
from torch.utils import _pytree as pytree
from torch.utils.data._utils.collate import default_collate_fn_map

T = TypeVar("T")


class Ragged(NamedTuple):
    """An axis along which one scene may have more than another.

    Attributes:
        axis: counted from the last, -1; or from the first behind the batch axes, 0.
        fill: what padding holds; None repeats the last entry, and is 0 where there is none.
        behind: of an axis counted from the first, a field, and how many axes it has beside the batch's.
    """

    axis: int
    fill: float | None = 0.0
    behind: tuple[str, int] | None = None


class _Kind(NamedTuple):
    """What is known of a registered dataclass: its ragged fields, and those whose plain numbers are leaves."""

    ragged: Mapping[str, Ragged]
    data: frozenset[str]


_KINDS: dict[type, _Kind] = {}
_SETTINGS = (torch.nn.Module, str, float)  # no integers: transforms put those in the place of leaves


def container(ragged: Mapping[str, Ragged] | None = None, data: Sequence[str] = ()) -> Callable[[type[T]], type[T]]:
    """Class decorator: registers a dataclass as a pytree, and with the `DataLoader`'s collate.

    What is put together again is not checked anew: a transform may put other things than tensors in their place.

    Args:
        ragged: fields that may be padded, tensors or mappings of such, and how.
        data: fields whose floats are leaves too; others count as settings.
    """
    about = _Kind(dict(ragged or {}), frozenset(data))

    def register(kind: type[T]) -> type[T]:
        names = tuple(part.name for part in fields(cast(Any, kind)))
        _KINDS[kind] = about

        def flatten(value: T) -> tuple[list[Any], Any]:
            leaves: list[tuple[str, Any]] = []
            settings: list[tuple[str, Any]] = []
            for name in names:
                part = getattr(value, name)
                held = part is None or (name not in about.data and isinstance(part, _SETTINGS))
                (settings if held else leaves).append((name, part))
            return [part for _, part in leaves], (tuple(name for name, _ in leaves), tuple(settings))

        def unflatten(leaves: Any, context: Any) -> T:  # noqa: ANN401  (pytree's own)
            own, settings = context
            return _made(kind, dict(zip(own, leaves, strict=True)) | dict(settings))

        def flatten_with_keys(value: T) -> tuple[list[Any], Any]:
            leaves, context = flatten(value)
            return [(pytree.GetAttrKey(name), leaf) for name, leaf in zip(context[0], leaves, strict=True)], context

        pytree.register_pytree_node(
            kind,
            flatten,
            unflatten,
            serialized_type_name=f"{kind.__module__}.{kind.__qualname__}",
            flatten_with_keys_fn=flatten_with_keys,
        )
        default_collate_fn_map[kind] = lambda batch, *, collate_fn_map=None: collate(batch)
        return kind

    return register


def stack(items: Sequence[T]) -> T:
    """Items of one kind along a new first axis; of a container all tensors and numbers.

    Args:
        items: containers, tensors, numbers, or tuples, mappings and named tuples of such; None stays None.

    Raises:
        ValueError: they are none, of different kinds, or tensors of different shapes (`pad` makes them equal).
    """
    if not items:
        raise ValueError("Expected at least one item to stack, got none")
    return _together(list(items), "item", torch.stack)


def join(batches: Sequence[T]) -> T:
    """Batches one after the other along their first axis, padded (`pad`).

    Args:
        batches: of one kind; numbers that are no tensors are those of all.

    Raises:
        ValueError: they are none, or do not go together.
    """
    if not batches:
        raise ValueError("Expected at least one batch to join, got none")
    return _together(pad(batches), "batch", torch.cat, True)


def pad(items: Sequence[T]) -> list[T]:
    """The items with each ragged axis of their containers as long as the longest of them.

    Padding counts for nothing: points are not valid, particles have the log-weight -inf, instants repeat the last one.

    Raises:
        ValueError: they are of different kinds.
    """
    return _padded(list(items), "item") if items else []


def collate(items: Sequence[T]) -> T:
    """The items padded and stacked: the `collate_fn` of a `DataLoader`."""
    return stack(pad(items))


def index(batch: T, at: int | slice | Tensor) -> T:
    """Scene, or scenes, of a batch; padding stays.

    Args:
        batch: whose tensors all have the scenes along their first axis.
        at: number, range, or a tensor of numbers or bools.
    """
    return pytree.tree_map_only(Tensor, lambda part: part[at], batch)


def detach(value: T) -> T:
    """The same numbers without a graph."""
    return pytree.tree_map_only(Tensor, Tensor.detach, value)


def _made(kind: type[T], values: Mapping[str, Any]) -> T:
    """A dataclass of these fields, as `copy.copy` makes one: nothing is checked."""
    made = object.__new__(kind)
    for name, part in values.items():
        object.__setattr__(made, name, part)
    return made


def _of(items: list[Any], name: str) -> type:
    """The kind that all items are."""
    kind = type(items[0])
    others = {type(item).__name__ for item in items if type(item) is not kind}
    if others:
        raise ValueError(f"Expected all of {name} to be {kind.__name__}, got {', '.join(sorted(others))} too")
    return kind


def _parts(items: list[Any], name: str) -> dict[str, list[Any]] | None:
    """The parts of which all items consist, by name; None of what has no parts."""
    first = items[0]
    if isinstance(first, Mapping):
        if any(set(item) != set(first) for item in items):
            raise ValueError(f"Expected all of {name} to have the same names {sorted(first)}, got others too")
        return {key: [item[key] for item in items] for key in first}
    if isinstance(first, tuple | list):
        if any(len(item) != len(first) for item in items):
            raise ValueError(f"Expected all of {name} to have {len(first)} parts, got others too")
        return {str(k): [item[k] for item in items] for k in range(len(first))}
    if is_dataclass(first):
        return {part.name: [getattr(item, part.name) for item in items] for part in fields(first)}
    return None


def _like(first: Any, parts: dict[str, Any]) -> Any:  # noqa: ANN401  (what it is)
    """The same kind of thing with other parts."""
    if isinstance(first, Mapping):
        return parts
    if isinstance(first, tuple | list):
        return type(first)(*parts.values()) if hasattr(first, "_fields") else type(first)(parts.values())
    return _made(type(first), parts)


def _together(items: list[Any], name: str, how: Callable[[list[Tensor]], Tensor], shared: bool = False) -> Any:  # noqa: ANN401
    """The items as one, their tensors put together; numbers that are `shared` have to be the same."""
    first = items[0]
    if isinstance(first, torch.nn.Module):
        if any(item is not first for item in items):
            raise ValueError(f"Expected {name} to be one module for all, got several: a batch shares its modules")
        return first
    kind = _of(items, name)
    if first is None or issubclass(kind, str) or (shared and issubclass(kind, bool | int | float)):
        if any(item != first for item in items):
            raise ValueError(f"Expected {name} to be {first!r} in all, got others too: a batch shares its settings")
        return first
    if issubclass(kind, Tensor):
        shapes = sorted({tuple(item.shape) if how is torch.stack else tuple(item.shape[1:]) for item in items})
        if len(shapes) > 1:
            raise ValueError(
                f"Expected all of {name} to have one shape, got {', '.join(map(str, shapes))}: use collate, which pads "
                "what may be padded"
            )
        return how(items)
    if issubclass(kind, bool | int | float):
        return torch.tensor(items)
    if is_dataclass(first) and kind not in _KINDS:
        raise ValueError(f"Expected {name} to be a registered container, got {kind.__name__}: see sdf.containers")
    parts = _parts(items, name)
    if parts is None:
        raise ValueError(f"Expected {name} to be a tensor or a container of such, got {kind.__name__}")
    data: Container[str] = _KINDS[kind].data if is_dataclass(first) else parts
    one = how is torch.cat
    return _like(
        first, {part: _together(own, f"{name}.{part}", how, one or part not in data) for part, own in parts.items()}
    )


def _padded(items: list[Any], name: str) -> list[Any]:
    if isinstance(items[0], torch.nn.Module | Tensor):
        return items
    kind = _of(items, name)
    parts = _parts(items, name)
    if parts is None:
        return items
    ragged = _KINDS[kind].ragged if kind in _KINDS else {}
    for part, values in parts.items():
        if part in ragged and any(value is not None for value in values):
            how = ragged[part]
            if how.behind is not None:
                how = how._replace(axis=how.axis + getattr(items[0], how.behind[0]).ndim - how.behind[1])
            parts[part] = _lengthened(values, how, f"{name}.{part}")
        elif all(value is not None for value in values):
            parts[part] = _padded(values, f"{name}.{part}")
    return [_like(items[0], {part: values[k] for part, values in parts.items()}) for k in range(len(items))]


def _lengthened(values: list[Any], how: Ragged, name: str) -> list[Any]:
    if isinstance(values[0], Mapping):
        parts = {key: _lengthened(own, how, f"{name}.{key}") for key, own in (_parts(values, name) or {}).items()}
        return [{key: own[k] for key, own in parts.items()} for k in range(len(values))]
    if any(not isinstance(value, Tensor) for value in values):
        raise ValueError(f"Expected all of {name} to be tensors, or none, got some")
    longest = max(value.shape[how.axis] for value in values)
    return [_longer(value, longest, how) for value in values]


def _longer(value: Tensor, longest: int, how: Ragged) -> Tensor:
    own = value.shape[how.axis]
    if own == longest:
        return value
    shape = list(value.shape)
    shape[how.axis] = longest - own
    if how.fill is None and own:
        more = value.narrow(how.axis, own - 1, 1).expand(shape)
    else:
        more = value.new_full(shape, how.fill or 0)
    return torch.cat((value, more), how.axis)
