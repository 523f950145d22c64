"""The compiled CPU version of trajectories in space; `toppled_object.py` has the definition."""

import math

import numpy as np

from rumi.belief.silence_numba import SILENT, told_by_silence
from rumi.dynamics.tool_contact_numba import bounded, clear, float32, placed, tool_of
from rumi.dynamics.toppling_numba import pushed
from sdf.compiled import Kernel, bare, inlined
from sdf.grid_numba import at, between, fast, lattice_of, value
from sdf.part_numba import indices

_SLACK = 1e-6  # nats by which sums in another order may differ
_APART_M = 1e-5  # that rounding may take from a distance


@fast
def _readings(first, last, frame, points, weight, row, priced, inverse, half, top, flat, lattice):
    """Log-likelihood of the points from one to before another, of their distances from the surface by a table."""
    r00, r01, r02, r10, r11, r12, r20, r21, r22, x, y, z = frame
    count, total = len(weight), np.float32(0.0)
    for m in range(first, last):
        dx, dy, dz = at(points, m) - x, at(points, count + m) - y, at(points, 2 * count + m) - z
        found = value(
            r00 * dx + r10 * dy + r20 * dz,
            r01 * dx + r11 * dy + r21 * dz,
            r02 * dx + r12 * dy + r22 * dz,
            flat,
            lattice,
        )
        total += at(weight, m) * between(found * inverse + half, top, priced, at(row, m))
    return total


@inlined
def _untouched(state, frame, after, numbers, tool, box):
    """How far the tool may go from a pose of its own until it can meet an object at rest; 0 where it may now."""
    if state[4] >= 0:
        return 0.0
    if (after[0] - state[0]) ** 2 + (after[1] - state[1]) ** 2 >= numbers[0] * numbers[0]:
        return _APART_M
    bounded(frame, after, tool, box)
    return float(clear(tool))


@bare
def _went(last, after, radius):
    """How far any point of the tool went between two of its poses, at most."""
    x, y, z = after[0] - last[0], after[1] - last[1], after[3] - last[3]
    return math.sqrt(x * x + y * y + z * z) + radius * abs(after[2] - last[2])


@bare
def _noisy(state, size, unit_x, unit_y, noise, scales):
    """State after a motion of a size in a direction, and its noise."""
    x, y, yaw, rest, edge, tilt = state
    along, across = noise[0] * size * scales[9], noise[1] * size * scales[10]
    x, y = x + along * unit_x - across * unit_y, y + along * unit_y + across * unit_x
    return x, y, yaw + noise[2] * size * scales[11], rest, edge, tilt


@bare
def _one(n, particles, done, turns, sensed, scene, numbers, scales, logs_of):
    """One particle, from its own segment on; what cannot reach its least log-likelihood any more is given up."""
    first, least, poses, logs, physics, noises = particles
    path, pushes, ends, action, point_ends = done
    points, weight, row = sensed
    tool, box, rests, flat, lattice = scene
    nodes = logs_of.shape[1]
    priced, inverse = logs_of.reshape(-1), np.float32(1.0 / scales[15])
    half, top = np.float32(0.5 * (nodes - 1)), np.float32(nodes - 1.01)
    begin, total = first[n], 0.0
    state = (
        poses[n, begin, 0],
        poses[n, begin, 1],
        poses[n, begin, 2],
        np.int64(poses[n, begin, 3]),
        np.int64(poses[n, begin, 4]),
        poses[n, begin, 5],
    )
    frame = placed(state[0], state[1], state[2], state[3], state[4], state[5], rests)
    apart, last = 0.0, (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    sizes = (scales[12], scales[16], scales[18], scales[25])
    ahead = scales[4] + scales[5] * physics[n, 4]
    centre_x, centre_y = scales[6] * physics[n, 2], scales[6] * physics[n, 3]
    own, together = math.sqrt(1.0 - scales[14]), math.sqrt(scales[14])
    for segment in range(begin, len(ends)):
        shared, log = action[segment], 0.0
        friction = scales[0] * math.exp(scales[1] * physics[n, 0] + scales[7] * noises[n, segment, 0])
        lever = scales[2] * math.exp(scales[3] * physics[n, 1] + scales[8] * noises[n, segment, 1])
        size = numbers[1] * math.exp(0.5 * scales[13] * noises[n, shared, 8] * noises[n, shared, 8])
        noise = (
            size * (own * noises[n, segment, 2] + together * noises[n, shared, 5]),
            size * (own * noises[n, segment, 3] + together * noises[n, shared, 6]),
            size * (own * noises[n, segment, 4] + together * noises[n, shared, 7]),
        )
        firm, soft = math.exp(scales[17] * noise[2]), scales[19] * math.exp(scales[20] * noise[1])
        grip = min(max(scales[22] * (noise[0] / numbers[1] - scales[21]), 0.0), 1.0)
        body = (centre_x, centre_y, ahead, lever, friction, soft, grip)
        for instant in range(ends[segment - 1] if segment > 0 else 0, ends[segment]):
            if pushes[instant]:
                before = (path[instant, 0, 0], path[instant, 0, 1], path[instant, 0, 2], path[instant, 0, 3])
                after = (
                    path[instant, 1, 0],
                    path[instant, 1, 1],
                    path[instant, 1, 2],
                    path[instant, 1, 3],
                    turns[instant, 0],
                    turns[instant, 1],
                )
                if apart - _APART_M <= _went(last, after, numbers[2]):
                    apart, last = _untouched(state, frame, after, numbers, tool, box), after
                    if not apart > 0.0:
                        state, went, unit_x, unit_y = pushed(state, frame, before, after, body, firm, sizes, scene)
                        state = _noisy(state, went, unit_x, unit_y, noise, scales)
                        frame = placed(state[0], state[1], state[2], state[3], state[4], state[5], rests)
            low, high = point_ends[instant - 1] if instant > 0 else 0, point_ends[instant]
            behind = high
            while behind > low and row[behind - 1] == SILENT:
                behind -= 1
            if low < behind:
                log += _readings(
                    low, behind, float32(frame), points, weight, row, priced, inverse, half, top, flat, lattice
                )
            if behind < high:
                told = _readings(
                    behind, high, float32(frame), points, weight, row, priced, inverse, half, top, flat, lattice
                )
                log += told_by_silence(told, scales[23], scales[24] if segment == len(ends) - 1 else 1.0)
            # no reading's log-likelihood is above 0: what is too little now stays so
            if total + log < least[n] - _SLACK:
                logs[n, segment] = -math.inf
                return
        poses[n, segment + 1, 0], poses[n, segment + 1, 1], poses[n, segment + 1, 2] = state[0], state[1], state[2]
        poses[n, segment + 1, 3], poses[n, segment + 1, 4] = state[3], state[4]
        poses[n, segment + 1, 5] = state[5]
        logs[n, segment] = log
        total += log


def _replay_in_space(particles, done, sensed, tool, box, rests, numbers, scales, priced, grid, part):
    path, turns = done[0], np.empty((len(done[0]), 2))
    for instant in range(len(path)):
        turns[instant, 0], turns[instant, 1] = math.cos(path[instant, 1, 2]), math.sin(path[instant, 1, 2])
    scene = (
        tool_of(tool[0], tool[1]),
        (box[0], box[1], box[2], box[3], box[4], box[5]),
        rests,
        grid[0],
        lattice_of(grid[1], grid[2]),
    )
    for n in indices(part, len(particles[0])):
        _one(np.int64(n), particles, done, turns, sensed, scene, numbers, scales, priced)


replay = Kernel(_replay_in_space)
