"""Exclusive ownership of output channels. Pure.

Concurrency: one thread; one daemon owns all claims, so two writers that race meet here one after
the other and exactly one wins.
"""

from __future__ import annotations

from typing import Generic, TypeVar

from .names import Claim, Node

Owner = TypeVar("Owner")


class Claims(Generic[Owner]):
    """Who owns which channel, or which bit of it."""

    def __init__(self) -> None:
        self._by_channel: dict[tuple[str, int, int], dict[int, Owner]] = {}

    def holder(self, node: Node) -> Owner | None:
        """Return who stands in the way of an open of this node, if anybody."""
        for claim in node.claims():
            owners = self._by_channel.get(claim[:3])
            if not owners:
                continue
            bit = claim[3]
            if bit < 0:
                return next(iter(owners.values()))
            if bit in owners:
                return owners[bit]
            if -1 in owners:
                return owners[-1]
        return None

    def take(self, claims: list[Claim], owner: Owner) -> None:
        """Give claims to an owner; the caller has asked ``holder`` first."""
        for claim in claims:
            self._by_channel.setdefault(claim[:3], {})[claim[3]] = owner

    def release(self, claims: list[Claim]) -> None:
        """Free claims."""
        for claim in claims:
            owners = self._by_channel.get(claim[:3])
            if owners is not None:
                owners.pop(claim[3], None)
                if not owners:
                    del self._by_channel[claim[:3]]

    def __len__(self) -> int:
        return sum(len(owners) for owners in self._by_channel.values())
