"""A simulated driver with its pages, ticked as the loop does, by steps where it may."""

import os
from types import MappingProxyType

import msgspec
import numpy as np

from sioms.drivers.sim.axes import SimAxes
from sioms.sdk.pages import Pages

PERIOD_NS = 1_000_000
MOTOR = {"mass": 2.0, "viscous": 4.0, "coulomb": 3.0, "stiction": 4.0, "encoder_step": 1e-6, "limit_plus": 0.25}
STEPPER = {"mass": 0.1, "step": 1e-3, "hold_force": 20.0, "coulomb": 1.0, "limit_minus": -0.1}
AXIS = {"velocity_max": 0.5, "acceleration_max": 5.0, "force_max": 40.0, "position_min": -0.2, "position_max": 0.28}


BEAMS = [{"boxes": [{"a": [0.02, 0.05]}, {"a": [0.04, 0.06], "c": [0.0, 1.0]}]}, {"boxes": [{"b": [-0.01, 0.0]}]}]


class Kit:
    markers = None
    inputs = MappingProxyType({})

    def __init__(self, cell):
        self.cell = cell

    def log(self, level, text): ...

    def publish(self, block, stamp_ns):
        """Publish in the middle of a tick: nothing has been served since the last one."""
        pages = self.cell.pages
        pages.publish(block, stamp_ns, self.cell.number, pages.as_of_ns(block))


class Cell:
    """A driver with its pages, ticked as the loop does, by steps where it may."""

    def __init__(self, by_steps, make_up_ns=10**15):
        axes = [
            AXIS | {"name": "a", "motor": MOTOR},
            {k: v for k, v in AXIS.items() if k != "force_max"} | {"name": "c", "stepper": STEPPER},
            AXIS | {"name": "b", "motor": MOTOR | {"wall": {"position": 0.15, "stiffness": 2e4, "damping": 20.0}}},
        ]
        settings = msgspec.convert({"axis": axes, "beam": BEAMS}, SimAxes.Settings)
        self.driver = SimAxes("mod0", settings, Kit(self))
        self.driver.make_up_ns = make_up_ns
        self.pages = Pages("mod0", self.driver.blocks, 10**9, 1, lambda blocks, state, reason: None)
        for fd in self.pages.fds:
            os.close(fd)
        self.instants = np.zeros(2, dtype=np.int64)
        steps = self.driver.quiet_steps(self.pages, self.instants)
        self.steps = steps if by_steps else None
        self.number, self.quiet, self.begun = 0, 0, 0

    def tick(self, now_ns, awaited=False):
        self.number += 1
        self.begun = 0
        if not (self.steps and self.by_step(now_ns, awaited=awaited)):
            self.driver.tick(now_ns)
            for block in self.driver.blocks:
                self.pages.publish(block, block.stamp_ns or now_ns, self.number, now_ns)
            self.driver.slack(now_ns, now_ns + 10 * PERIOD_NS)

    def rest(self, now_ns, watched=False):
        """Tick after a while in which nobody looked, and tell whether all is at rest."""
        self.number += 1
        if self.steps and self.by_step(now_ns, watched):
            self.steps.is_ready(watched)
            rests = self.steps.rest(self.steps.record, 0, 0, 0)
            self.steps.resume()
            return bool(rests)
        self.driver.tick(now_ns)
        for block in self.driver.blocks:
            self.pages.publish(block, now_ns, self.number, now_ns)
        self.driver.slack(now_ns, now_ns + 10 * PERIOD_NS)
        return self.driver.is_at_rest()

    def by_step(self, now_ns, watched=True, awaited=False):
        steps = self.steps
        if not steps.is_ready(watched, awaited) or not self.pages.lend():
            return False
        done = steps.tick(steps.record, now_ns, now_ns, self.number) == 0
        self.quiet += done
        self.begun = steps.record.plans.started * done
        slackens = done and steps.slack(steps.record, now_ns, now_ns + PERIOD_NS, 0)
        self.pages.take_back()
        steps.resume()
        if slackens:
            self.driver.slack(now_ns, now_ns + 10 * PERIOD_NS)
        return done

    def shown(self):
        return [
            (self.pages._writers[id(block)]._bytes[72:80].tobytes(), bytes(self.pages._words[id(block)][32:]))
            for block in self.driver.blocks
        ]
