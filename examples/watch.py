"""Wait on several nodes at once with the standard library's selectors, and print what changes."""

import selectors
import sys
import time

import sioms


def main(seconds: float) -> None:
    with sioms.Workcell() as cell, selectors.DefaultSelector() as selector:
        seen = {}
        for name in ("mod0.readonly", "beams", "lord1"):
            node = cell.open(name)
            node.subscribe(-1 if name == "beams" else 100)
            selector.register(node, selectors.EVENT_READ, node)
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            for key, _ in selector.select(left):
                node = key.data
                snapshot = node.read()
                values = snapshot.position if node.info.node_class is sioms.NodeClass.AXIS else snapshot.data
                rounded = tuple(round(value, 2) for value in values)
                if seen.get(node.name) != rounded:
                    seen[node.name] = rounded
                    print(f"{snapshot.stamp_ns / 1e9:.3f} {node.name:14} {rounded}", flush=True)


if __name__ == "__main__":
    main(float(sys.argv[1]) if len(sys.argv) > 1 else 5.0)
