"""Two modules moved by two tasks of one event loop, while a third watches the beams."""

import asyncio

import sioms.aio


async def shuttle(cell: sioms.aio.AsyncWorkcell, node: str, places: list[float]) -> None:
    async with await cell.open(node, "rw") as axis:
        for place in places:
            await axis.command(position=place)
            await axis.wait_until_idle(timeout=5.0)
            print(f"{node} at {axis.read().position[0]:.3f}")


async def watch(cell: sioms.aio.AsyncWorkcell) -> None:
    async with await cell.open("beam0") as beam:
        edge = beam.read()
        while True:
            edge = await beam.wait_event(last=edge)
            print("beam 0", "broken" if edge.final else "free")


async def main() -> None:
    async with await sioms.aio.connect() as cell:
        watcher = asyncio.create_task(watch(cell))
        await asyncio.gather(shuttle(cell, "mod0.xaxis", [0.2, 0.0]), shuttle(cell, "mod1.xaxis", [0.1, 0.0]))
        watcher.cancel()
        await asyncio.gather(watcher, return_exceptions=True)


if __name__ == "__main__":
    asyncio.run(main())
