"""A robot that uses rumi without importing it: a made-up gripper, and a box that gives way to it.

rumi serve --builtin box --motion measured --workspace 0.2 -0.3 0.06 0.85 0.3 0.06
python scripts/bridge_client.py
"""

import cmath
import json
import math
import socket
import sys
from operator import itemgetter

HALF, TURN = (0.030, 0.079), cmath.rect(1.0, 0.4)  # half sides of the box, metres, and its yaw; x + iy is a place
RIM = [complex(0.035 * math.cos(k / 5), side + 0.018 * math.sin(k / 5)) for k in range(32) for side in (-0.024, 0.024)]
box = 0.55 + 0.03j  # where it is: nobody tells rumi


def touches(pose):  # of each point of the pads: its distance from the box, itself, and the box's surface there
    for point in (complex(*pose[:2]) + complex(pose[6], pose[5]) ** 2 * rim for rim in RIM):
        at = (point - box) / TURN
        near = [at.real, at.imag]
        out = [abs(value) - half for value, half in zip(near, HALF, strict=True)]
        side = out.index(max(out))
        near[side] = math.copysign(HALF[side], near[side])
        yield out[side], point, box + complex(*near) * TURN


with socket.create_connection(("127.0.0.1", int(sys.argv[1]) if len(sys.argv) > 1 else 7711)) as connection:
    lines, tool = connection.makefile("rw"), [0.25, 0.0, 0.06, 0.0, 0.0, 0.0, 1.0]
    for told in map(json.loads, lines):
        said = []
        if told["type"] == "hello":  # what a camera sees: the front
            front = [box + complex(-HALF[0], 0.01 * v) * TURN for v in range(-7, 8)]
            seen = [[at.real, at.imag, 0.01 * z] for at in front for z in range(21)]
            said.append({"type": "start", "tool": tool, "surface": seen})
        elif told["type"] == "belief":
            print(told["step"], told["sure"], *told["pose"]["position_m"])
        elif told["type"] == "action":
            before = box
            for tool in told["path"]:
                distance, point, surface = min(touches(tool), key=itemgetter(0))
                box += point - surface if distance < 0 else 0  # it gives way
                felt = [[at.real, at.imag, tool[2]] for distance, _, at in touches(tool) if distance < 0.001]
                motion = [(box - before).real, (box - before).imag, 0, 0, 0, 0, 1]
                said.append({"type": "sample", "tool": tool, "touched": felt, "motion": motion})
            said.append({"type": "done"})
        else:  # end or error
            print(told, "true place", box.real, box.imag)
            break
        print(*map(json.dumps, said), sep="\n", end="\n" * bool(said), file=lines, flush=True)
