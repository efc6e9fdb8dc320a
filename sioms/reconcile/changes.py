"""A number of the axis that changes in time: a load picked up, a brake that drags for a while, a supply that sags.

No function of the state says this, for the state comes back and the number does not. What a number must have been in
every short window of time is read off the residual by regression; then the sparsest courses are tried: it has two
values and switches between them, or it swings with one frequency.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sioms.reconcile.course import Course
from sioms.reconcile.fit import Fit, Problem, refit
from sioms.reconcile.swings import swinging
from sioms.reconcile.switches import switching
from sioms.reconcile.thresholds import GAIN, PROMISING
from sioms.reconcile.timed import known_beside
from sioms.reconcile.windows import NUMBERS, View

#: A course and the numbers of the model are fitted in turn at most so often, and until the force changes by less than
#: this share.
SETTLED, STILL = 8, 3e-3


def change(problem: Problem, fit: Fit) -> Course | None:
    """Find the change in time that explains most of a residual; of those that leave no more than noise the simplest.

    Returns:
        None where nothing changes.
    """
    view = View(problem, fit)
    worth = PROMISING * float(view.rest @ view.rest)
    courses: list[Course | None] = []
    for number in NUMBERS:
        read = view.read(number)
        if read is not None and read.left < worth:
            courses.append(switching(view, number, read))
            if number.symbol != "w":  # a force that swings is a tone
                courses.append(swinging(view, number, read))
    found = [c for c in courses if c is not None]
    least = min((c.left for c in found), default=np.inf)
    near = [c for c in found if c.left <= max(least / (1.0 - GAIN), len(fit.residual))]
    return min(near, key=lambda c: (c.count, c.left), default=None)


def settled(problem: Problem, fit: Fit, course: Course, frozen: Sequence[str]) -> Course:
    """Fit a change again beside a model whose numbers are fitted with it, not bent to stand for it.

    Args:
        fit: of a model that knows of no change; course: what explains most of what it leaves.
        frozen: effects that keep their values.
    """
    for _ in range(SETTLED):
        beside = known_beside(problem, course.forces)
        again = course.again(View(beside, refit(beside, fit.model, frozen), course.forces))
        if again.left > (1.0 + GAIN) * course.left:
            break
        before, course = np.concatenate(course.forces), again
        if np.linalg.norm(np.concatenate(course.forces) - before) < STILL * np.linalg.norm(before):
            break
    return course
