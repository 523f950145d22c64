"""A robot that uses rumi without importing it: a made-up gripper, and a box that gives way to it.

rumi serve --builtin box --motion measured --workspace 0.2 -0.3 0.06 0.85 0.3 0.06
python scripts/bridge_client.py
"""

import json
import math
import socket
import sys

HALF, TURN = (0.030, 0.079), (math.cos(0.4), math.sin(0.4))  # half sides of the box, metres, and its yaw
RIM = [(0.035 * math.cos(0.2 * k), side * 0.024 + 0.018 * math.sin(0.2 * k)) for k in range(32) for side in (-1, 1)]
box = [0.55, 0.03]  # where it is: nobody tells rumi


def on_box(u, v):
    return [box[0] + u * TURN[0] - v * TURN[1], box[1] + u * TURN[1] + v * TURN[0]]


def touches(pose):  # of each point of the pads: its distance from the box, itself, and the box's surface there
    c, s = pose[6] ** 2 - pose[5] ** 2, 2 * pose[5] * pose[6]
    for x, y in ((pose[0] + a * c - b * s, pose[1] + a * s + b * c) for a, b in RIM):
        dx, dy = x - box[0], y - box[1]
        at = [dx * TURN[0] + dy * TURN[1], dy * TURN[0] - dx * TURN[1]]
        deep = [abs(at[0]) - HALF[0], abs(at[1]) - HALF[1]]
        near = [max(-half, min(half, value)) for half, value in zip(HALF, at, strict=True)]
        if max(deep) < 0:
            side = deep.index(max(deep))
            near[side] = math.copysign(HALF[side], at[side])
        yield (max(deep) if max(deep) < 0 else math.dist(at, near)), (x, y), on_box(*near)


with socket.create_connection(("127.0.0.1", int(sys.argv[1]) if len(sys.argv) > 1 else 7711)) as connection:
    lines, tool = connection.makefile("rw"), [0.25, 0.0, 0.06, 0.0, 0.0, 0.0, 1.0]
    for told in map(json.loads, lines):
        said = []
        if told["type"] == "hello":  # what a camera sees: the front
            seen = [[*on_box(-HALF[0], 0.01 * v), 0.01 * z] for v in range(-7, 8) for z in range(21)]
            said = [{"type": "start", "tool": tool, "surface": seen}]
        elif told["type"] == "belief":
            print(told["step"], told["sure"], *told["pose"]["position_m"])
        elif told["type"] == "action":
            before = list(box)
            for tool in told["path"]:
                _, point, surface = min(touches(tool))
                if min(touches(tool))[0] < 0:  # the box gives way
                    box[:] = [b + p - s for b, p, s in zip(box, point, surface, strict=True)]
                felt = [[*surface, tool[2]] for distance, _, surface in touches(tool) if distance < 0.001]
                motion = [box[0] - before[0], box[1] - before[1], 0, 0, 0, 0, 1]
                said.append({"type": "sample", "tool": tool, "touched": felt, "motion": motion})
            said.append({"type": "done"})
        else:  # end or error
            print(told, "true place", *box)
            break
        print(*map(json.dumps, said), sep="\n", end="\n" * bool(said), file=lines, flush=True)
