"""How many samples a second the bridge takes in, on one core: `python -m scripts.bridge_rate`.

A client sends samples as fast as it can, with and without ten touched points; the server's thread counts its own
seconds of the processor, from the bytes to a reading with its free space. The belief's update, once an action, comes
on top.
"""

import json
import socket
import threading
import time

import torch

from rumi.bridge.messages import Start
from rumi.bridge.served import ServedRobot, Wire
from rumi.cli import script
from rumi.robot.gripper import GripperShape
from rumi.robot.tool import Tool

_SAMPLES, _ACTIONS = 1000, 10
_TOOL = (0.25, 0.0, 0.06, 0.0, 0.0, 0.0, 1.0)


def seconds(points: int) -> float:
    """Seconds of the processor for a sample, the least of some actions."""
    here, there = socket.socketpair()
    bounds = torch.tensor([[0.2, -0.3], [0.85, 0.3]])
    robot = ServedRobot(
        Wire(here),
        Start(_TOOL),
        Tool(bounds, None, shape=GripperShape(), height_m=0.06),
        False,
        torch.tensor([[0.2, -0.3, 0.0], [0.85, 0.3, 0.3]]),
    )
    robot.reset(0)
    tools = [[0.25 + 0.08 * k / _SAMPLES, *_TOOL[1:]] for k in range(_SAMPLES)]
    samples = [{"type": "sample", "tool": tool, "touched": [tool[:3]] * points} for tool in tools]
    data = b"".join(json.dumps(one).encode() + b"\n" for one in [*samples, {"type": "done"}])
    found = []
    for _ in range(_ACTIONS):
        threading.Thread(target=there.sendall, args=(data,)).start()
        begun = time.thread_time()
        robot.step(torch.zeros(3))
        found.append((time.thread_time() - begun) / _SAMPLES)
    return min(found)


def main() -> None:
    """Print microseconds a sample, and samples a second."""
    torch.set_num_threads(1)
    for touched in (0, 10):
        each = seconds(touched)
        print(f"{touched:2} touched points a sample: {1e6 * each:.0f} us, {1 / each:.0f} a second")


if __name__ == "__main__":
    script(main)
