"""Takes the steps of the parts of the model on the real objects, until each has been taken that they can take.

python tests/ownership_tour.py                   # all of them, in some minutes
python tests/ownership_tour.py --steps 20000     # as many of each device and part
"""

from __future__ import annotations

import argparse
import random
import sys
from collections import deque
from collections.abc import Callable, Iterator
from typing import NamedTuple

from ownership_cell import Cell, cells
from ownership_explorer import DEVICE_FIRST, Walk
from ownership_fakes import NAMES
from ownership_model import taken
from ownership_parts import BRAKE, ELSEWHERE, PARTS, RESTART, Part, Whole, go_through
from ownership_state import DEVICES, GUEST, NOBODY, UP, Action, State
from ownership_steps import BY_ITSELF, actions

LONGEST = 5_000
"""Steps of one workcell; then another is made."""
TRIES = 3
"""How often the real objects may not come to a step before it counts as none of theirs."""


class Toured(NamedTuple):
    """How many steps a part has, how many the real objects have taken, and how many steps that took."""

    steps: int
    taken: int
    length: int


class Tour:
    """The steps of a part that a device takes.

    Args:
        name: of the part.
        whole: all of it.
        d: the device; the other one does nothing that the part would notice.
        seed: of what is at random.
    """

    def __init__(self, name: str, whole: Whole, d: int, seed: int = 0) -> None:
        self.name, self.d, self.whole = name, d, whole
        self.part: Part = PARTS[name]
        self.chance = random.Random(seed)
        self.left = {state: dict.fromkeys(nexts, TRIES) for state, nexts in whole.items()}
        self.steps = self.open = sum(map(len, whole.values()))
        self.taken = 0

    def go(self, make: Callable[[], Cell], most: int) -> Toured:
        """Take steps on the real objects, ``most`` at most.

        Raises:
            AssertionError: these went elsewhere than the model.
        """
        length = 0
        while length < most and self.open:
            walk = Walk(make(), [("boot",)])
            while walk.length < min(LONGEST, most - length) and self._on(walk):
                pass
            if walk.length == 1:
                break
            length += walk.length
        return Toured(self.steps, self.taken, length)

    def _on(self, walk: Walk) -> bool:
        """Go to the nearest step that has not been taken, and take it; return whether there was one."""
        self._prepare(walk)
        route = self._route(self._seen(walk.state))
        if route is None:
            return False
        for state in route:
            before = self._seen(walk.state)
            action = self._action(walk.state, before, state)
            if action is None:
                self._give_up(before, state)
                return True
            self._take(walk, action)
            self._prepare(walk)
            if self._seen(walk.state) != state:
                self._give_up(before, state)
                return True
        return True

    def _seen(self, state: State) -> State:
        return self.part.alike(self.part.of(state, self.d))

    def _take(self, walk: Walk, action: Action) -> None:
        """Take a step, and what it is of the part off the list."""
        before = self._seen(walk.state)
        walk.take(action)
        if self.left[before].pop(after := self._seen(walk.state), None) is not None:
            self.open -= 1
            self.taken += 1
        assert after == before or after in self.whole[before] or action[0] in ("notice", "listen", "bury", "regrant")

    def _give_up(self, before: State, after: State) -> None:
        """Count a step that could not be taken."""
        tries = self.left[before].get(after)
        if tries == 1:
            del self.left[before][after]
            self.open -= 1
        elif tries:
            self.left[before][after] = tries - 1
        else:
            self._avoid(before, after)

    def _avoid(self, before: State, after: State) -> None:
        """Do not go through a step again that has been taken, and cannot be now."""
        self.whole[before].pop(after, None)

    def _route(self, start: State) -> list[State] | None:
        """Return the states through which one comes to the nearest step that has not been taken, and takes it."""
        came: dict[State, State | None] = {start: None}
        queue = deque([start])
        while queue:
            state = queue.popleft()
            if self.left[state]:
                route = [self.chance.choice(list(self.left[state]))]
                while came[state] is not None:
                    route.append(state)
                    state = came[state]  # type: ignore[assignment]
                return route[::-1]
            for after in self.whole[state]:
                if after not in came:
                    came[after] = state
                    queue.append(after)
        return None

    def _action(self, s: State, before: State, after: State) -> Action | None:
        """Return a step of the whole that is that one of the part; None when there is none at present."""
        wanted = self.whole[before].get(after)
        if wanted is None:
            return None
        kind = _AS.get(str(wanted[0]), wanted[0])
        choice = [a for a in actions(s) if a[0] == kind]
        self.chance.shuffle(choice)
        return next((a for a in choice if self._seen(taken(s, a)[0]) == after), None)

    def _prepare(self, walk: Walk) -> None:
        """Do what the part does not notice: let the other device come to rest, and give ours an owner."""
        while (action := next(self._unnoticed(walk.state), None)) is not None:
            self._take(walk, action)

    def _unnoticed(self, s: State) -> Iterator[Action]:
        before = self._seen(s)
        for action in actions(s):
            if self._is_preparing(s, action):
                after = taken(s, action)[0]
                if after != s and self._seen(after) == before:
                    yield action

    def _is_preparing(self, s: State, action: Action) -> bool:
        other = 1 - self.d
        if action[0] in DEVICE_FIRST and action[1] == other:
            return action[0] in BY_ITSELF
        if self.name == "owners":
            return action == ("tick", self.d)
        device = s.devices[self.d]
        if action[0] == "connect":
            return action[1] == 0
        if action == ("open", 0, self.d):
            return device.phase == UP and device.claim == NOBODY
        return action[0] in ("hear", "listen", "notice") and action[1] in (self.d, 0, 1, GUEST)


_AS = {BRAKE: "expire", ELSEWHERE: "tick", RESTART: "reset_node"}
"""What the whole does that a part calls by names of its own."""


def tour(name: str, whole: Whole, d: int, most: int, seed: int = 0) -> Toured:
    """Tour a part on a device."""
    with cells() as make:
        return Tour(name, {state: dict(nexts) for state, nexts in whole.items()}, d, seed).go(make, most)


def main(arguments: list[str]) -> int:
    """Tour all parts on all devices, and tell how far that went."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=10**9, help="of each part and device")
    parser.add_argument("--seed", type=int, default=0, help="of what is at random")
    parser.add_argument("--part", choices=list(PARTS), help="one of them; default both")
    parser.add_argument("--device", type=int, choices=range(DEVICES), help="one of them; default both")
    options = parser.parse_args(arguments)
    for name in PARTS if options.part is None else [options.part]:
        whole = go_through(PARTS[name])
        print(f"{name}: {len(whole)} states, {sum(map(len, whole.values()))} steps, to the end", flush=True)
        for d in range(DEVICES) if options.device is None else [options.device]:
            found = tour(name, whole, d, options.steps, options.seed)
            print(f"real {NAMES[d]}: {found.taken} of {found.steps} steps, on a way of {found.length}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
