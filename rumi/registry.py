"""Registry of a family's members by name; members from other packages come by entry points."""

from collections.abc import Iterator
from functools import cached_property
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Generic, TypeVar

from rumi.errors import UsageError

T = TypeVar("T")


class Table(Generic[T]):
    """Registry of a family, such as the push models or the tasks: members by name.

    A member is an object or its address "module:name", which is imported when the member is first asked for, so that
    a simulator is loaded by nothing that does not use it. A package from outside adds a member by an entry point of the
    table's group, whose name is the member's:

        [project.entry-points."rumi.tasks"]
        shelf-bottle = "my_package.tasks:SHELF_BOTTLE"

    >>> table = Table[int]("number")
    >>> table.add("one", 1)
    1
    >>> table["one"], list(table), "two" in table
    (1, ['one'], False)

    Args:
        kind: what a member is called in messages, such as "push model".
        group: of the entry points that add members; None where no package can.
    """

    def __init__(self, kind: str, group: str | None = None) -> None:
        self.kind, self.group = kind, group
        self._members: dict[str, T | str] = {}
        self._mappings: list[str] = []

    def include(self, address: str) -> None:
        """Enter all members of a mapping by name, which stands at an address "module:name".

        It is imported when the names are listed, or when one is asked for that the table does not have.
        """
        self._mappings.append(address)

    def add(self, name: str, member: T | str) -> T | str:
        """Enter a member, or its address "module:name"; returns it.

        Raises:
            ValueError: the name is taken by another member.
        """
        if self._members.get(name, member) != member:
            raise ValueError(f"Expected a new name for a {self.kind}, got {name!r}, which is taken")
        self._members[name] = member
        return member

    @cached_property
    def _outside(self) -> dict[str, EntryPoint]:
        if self.group is None:
            return {}
        return {entry.name: entry for entry in entry_points(group=self.group)}

    def _load_mappings(self) -> None:
        for address in self._mappings:
            self._members = {**_load(address), **self._members}
        self._mappings = []

    def __getitem__(self, name: str) -> T:
        """The member of a name.

        Raises:
            UsageError: there is none; the message lists the names.
        """
        if name not in self._members:
            self._load_mappings()
        if name in self._members:
            member = self._members[name]
            if isinstance(member, str):
                member = self._members[name] = _load(member)
            return member
        if name in self._outside:
            return self._outside[name].load()
        raise UsageError(f"There is no {self.kind} {name!r}; there are {', '.join(self)}")

    def __contains__(self, name: object) -> bool:
        """Whether there is a member of that name."""
        return name in list(self)

    def __iter__(self) -> Iterator[str]:
        """Names, this project's first, each in the order in which it was entered."""
        self._load_mappings()
        yield from self._members
        yield from (name for name in self._outside if name not in self._members)

    def __len__(self) -> int:
        """Number of members."""
        return len(list(iter(self)))


def _load(address: str) -> Any:  # noqa: ANN401  (whatever stands there)
    module, _, attribute = address.partition(":")
    return getattr(import_module(module), attribute)
