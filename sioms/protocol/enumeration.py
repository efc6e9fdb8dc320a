"""IntEnum and IntFlag as the standard library has them, as far as the protocol needs them.

The module ``enum`` and the classes made with it cost 7 ms of the 25 ms in which a shell tool starts and
answers. These cost 0.5 ms. Type checkers are shown the originals; a test holds both side by side.
"""

from __future__ import annotations

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Iterator
    from typing import Any


class _Members(type):
    """Makes the integers in the body of a class its members.

    Concurrency: members are made once; composite flags are remembered in a dict, which any thread may fill.
    """

    _by_value: dict[int, Any]
    _mask: int
    __members__: dict[str, Any]

    def __new__(mcs, name: str, bases: tuple[type, ...], body: dict[str, Any]) -> Any:
        values = {key: value for key, value in body.items() if key[0] != "_" and type(value) is int}
        for key in values:
            del body[key]
        cls: Any = type.__new__(mcs, name, bases, body)
        cls._by_value = {}
        cls._mask = 0
        for key, value in values.items():
            member = cls._make(value, key)
            cls._by_value.setdefault(value, member)
            cls._mask |= value
            type.__setattr__(cls, key, member)
        cls.__members__ = {key: getattr(cls, key) for key in values}
        return cls

    def _make(cls, value: int, name: str | None) -> Any:
        member: Any = int.__new__(cls, value)  # type: ignore[arg-type]  # a class of integers
        member.__dict__["name"] = name
        member.__dict__["value"] = value
        return member

    def __call__(cls, value: Any) -> Any:
        member = cls._by_value.get(value)
        return member if member is not None else cls._missing(value)

    def _missing(cls, value: Any) -> Any:
        raise ValueError(f"{value!r} is not a valid {cls.__name__}")

    def __iter__(cls) -> Iterator[Any]:
        return iter(cls.__members__.values())

    def __len__(cls) -> int:
        return len(cls.__members__)

    def __contains__(cls, value: int) -> bool:
        return value in cls._by_value and cls._by_value[value].name in cls.__members__

    def __getitem__(cls, name: str) -> Any:
        return cls.__members__[name]

    def __setattr__(cls, name: str, value: object) -> None:
        if name in cls.__dict__.get("__members__", ()):
            raise AttributeError(f"cannot reassign member {name!r}")
        type.__setattr__(cls, name, value)


class IntEnum(int, metaclass=_Members):
    """Members are integers with a ``name``."""

    name: str | None

    def __repr__(self) -> str:
        return f"<{type(self).__name__}{'.' + self.name if self.name else ''}: {int(self)}>"

    def __str__(self) -> str:
        return int.__repr__(self)

    def __setattr__(self, name: str, value: object) -> None:
        raise AttributeError(f"member {self!r} cannot be changed")

    def __reduce_ex__(self, _protocol: object) -> tuple[type, tuple[int]]:
        return type(self), (int(self),)


class _Flags(_Members):
    def _missing(cls, value: Any) -> Any:
        """Make a composite; bits without a name are kept, as the original keeps them."""
        if not isinstance(value, int):
            raise ValueError(f"{value!r} is not a valid {cls.__name__}")
        if value < 0:
            return cls((1 << max(cls._mask.bit_length(), value.bit_length())) + value)
        names = [key for key, member in cls.__members__.items() if int(member) & value]
        rest = value & ~cls._mask
        name = "|".join(names + [str(rest)] * bool(rest)) if names else None
        return cls._by_value.setdefault(value, cls._make(int(value), name))


class IntFlag(IntEnum, metaclass=_Flags):
    """Members are single bits; composites belong to the class, too."""

    def __or__(self, other: int) -> Any:
        return type(self)(int(self) | int(other)) if isinstance(other, int) else NotImplemented

    def __and__(self, other: int) -> Any:
        return type(self)(int(self) & int(other)) if isinstance(other, int) else NotImplemented

    def __xor__(self, other: int) -> Any:
        return type(self)(int(self) ^ int(other)) if isinstance(other, int) else NotImplemented

    __ror__, __rand__, __rxor__ = __or__, __and__, __xor__

    def __invert__(self) -> Any:
        return type(self)(~int(self))

    def __contains__(self, other: int) -> bool:
        return int(other) & int(self) == int(other)

    def __iter__(self) -> Iterator[Any]:
        return iter([member for member in type(self) if int(member) & int(self)])

    def __len__(self) -> int:
        return int(self).bit_count()

    def __bool__(self) -> bool:
        return int(self) != 0
