"""What commands have set, gains and limits, ends with the handle of their client."""

from __future__ import annotations

import random

import pytest
from own_writes_rig import World, own_time

from sioms.drivers.sim.axes import SimAxes
from sioms.protocol.flags import ControlMode, NodeClass
from sioms.protocol.records import AXIS_WRITE, WRITE
from sioms.sdk.blocks import AxisBlock

AXIS = {"velocity_max": 0.5, "acceleration_max": 5.0, "motor": {"mass": 1.0}, "force_max": 60.0}
SETS = ControlMode.SPECIFIED_GAINS | ControlMode.SPECIFIED_MAX_VEL_ACC | ControlMode.SPECIFIED_MAX_FORCE


def record(axis: int, mode: ControlMode, **fields: float) -> bytes:
    fields |= {"axis": axis, "control_mode": int(mode), "velocity": 0.1}
    return AXIS_WRITE.pack(*(fields.get(name, 0) for name in WRITE[NodeClass.AXIS]))


@pytest.mark.parametrize("whole", [False, True])
def test_what_commands_have_set_ends_with_their_client(whole: bool) -> None:
    made: list[World] = []
    with own_time(made):
        made.append(World.__new__(World))
        made[0].__init__(SimAxes, {"axis": [{"name": "x", **AXIS}, {"name": "y", **AXIS}]}, random.Random(1))  # type: ignore[misc]
        world = made[0]
        block = world.runtime.blocks[0]
        assert isinstance(block, AxisBlock)
        bank, axes = block.bank, [0, 1] if whole else [0]
        configured = bank.rows["k"].tolist()
        client = world.open(0, axes, exclusive=True)
        limits = {"max_velocity": 1e-4, "max_acceleration": 0.1, "max_force": 0.5}
        client.write(b"".join(record(axis, ControlMode.VELOCITY | SETS, **limits) for axis in axes))
        for _ in range(5):
            world.turn(calm=True)
        assert [bank.rows["k"][axis] for axis in axes] == [0.0] * len(axes)
        world.close_node(client)
        for _ in range(50):
            world.turn(calm=True)
        client = world.open(0, axes, exclusive=True)
        client.write(b"".join(record(axis, ControlMode.VELOCITY) for axis in axes), replace=True)
        for _ in range(100):
            world.turn(calm=True)
        assert bank.rows["k"].tolist() == configured
        assert [round(bank.rows["commanded_velocity"][axis], 6) for axis in axes] == [0.1] * len(axes)
        world.close()
