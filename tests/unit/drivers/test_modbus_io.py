"""The Modbus I/O driver against the simulated block's register model."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest
from modbus_rig import Kit

from sioms.drivers.modbus.io import ModbusIo
from sioms.drivers.modbus.simulated import moxa
from sioms.sdk.codec.modbus import frame_tcp
from sioms.sdk.exchange import DeviceError, Steps


class TestIo:
    def make(self, **table: Any) -> tuple[Any, moxa.Block]:
        settings = {"map": "moxa_e1200", "line": {"tcp": "h:502"}, "model": "E1212", **table}
        driver = ModbusIo("io0", msgspec.convert(settings, ModbusIo.Settings), Kit())
        return driver.units[0], moxa.Block(settings["model"])

    def run(self, block: moxa.Block, steps: Steps) -> None:
        value = None
        with pytest.raises(StopIteration):
            while True:
                exchange = steps.send(value)
                value = exchange.decode(self.answer(block, exchange.data))

    def answer(self, block: moxa.Block, request: bytes) -> bytes:
        function, address = request[7], int.from_bytes(request[8:10], "big")
        count = int.from_bytes(request[10:12], "big")
        if function == 4:
            words = block.read_input(address, count)
            body = bytes((4, 2 * count)) + np.array(words, ">u2").tobytes()
        elif function == 15:
            bits = int.from_bytes(request[13:], "little")
            assert block.write_bits(address, [bits >> i & 1 for i in range(count)]) is None
            body = request[7:12]
        else:
            bits = sum(bit << i for i, bit in enumerate(block.read_bits(function, address, count)))
            size = (count + 7) // 8
            body = bytes((function, size)) + bits.to_bytes(size, "little")
        return frame_tcp(int.from_bytes(request[:2], "big"), 1, body)

    def test_ports(self) -> None:
        unit, block = self.make(safe={"do": 3})
        inputs, outputs = unit.blocks
        assert (inputs.spec.name, outputs.spec.name) == ("", "do")
        assert outputs.spec.safe == (3,) and not inputs.spec.writable
        self.run(block, unit.open())
        block.set_input(4, 1)
        self.run(block, unit.write_outputs(outputs.spec, [0], [0x81]))
        self.run(block, unit.poll())
        assert block.do == [1, 0, 0, 0, 0, 0, 0, 1]
        assert (inputs.data[0], outputs.data[0]) == (0x10, 0x81)
        self.run(block, unit.poll())
        assert inputs.edges[0] == 1

    def test_analog(self) -> None:
        unit, block = self.make(model="E1240")
        (values,) = unit.blocks
        assert [c.name for c in values.spec.channels][:2] == ["ai0", "ai1"] and values.spec.channels[0].unit == "V"
        block.ramps[2] = (0.0, 0.0, 5.0, 0.0)
        block.ramps[3] = (0.0, 0.0, 12.0, 0.0)
        self.run(block, unit.open())
        self.run(block, unit.poll())
        assert values.data[2] == pytest.approx(5.0, abs=1e-3) and values.flags.tolist() == [
            0,
            0,
            0,
            1,
            0,
            0,
            0,
            0,
        ]

    def test_another_model_is_refused(self) -> None:
        unit, _ = self.make()
        with pytest.raises(DeviceError, match="model is 'E1240'; the configuration says E1212"):
            self.run(moxa.Block("E1240"), unit.open())

    @pytest.mark.parametrize(
        ("change", "words"),
        [
            ({"model": "E1122"}, "not in the map; did you mean E1"),
            ({"model": ""}, "model: none given; want one of E1210"),
            ({"model": "", "channels": {"dii": 4}}, "channels.dii: no such port; did you mean di"),
            ({"channels": {"di": 40}}, "channels.di = 40; want 0 to 16"),
            ({"safe": {"di": 1}}, "safe.di: no output of this device"),
            ({"safe": {"do": 256}}, "safe.do = 256; want an integer from 0 to 255"),
            ({"main": "ai"}, "main = ai: no port of this device"),
            ({"watchdog_s": 1.0}, "the map cannot set one"),
            ({"map": "leadshine"}, "describes no ports"),
        ],
    )
    def test_bad_configurations(self, change: dict[str, Any], words: str) -> None:
        table = {"map": "moxa_e1200", "line": {"tcp": "h:502"}, "model": "E1212", **change}
        with pytest.raises(ValueError, match=words):
            ModbusIo.describe("io0", msgspec.convert(table, ModbusIo.Settings))
