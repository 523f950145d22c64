"""Rigid transforms: exponential, logarithm, products, means and their gradients, to half a turn and at none."""

import math
from functools import partial
from typing import Any

import torch
from torch import Tensor

from sdf import se3, so3
from tests.stress import exact, measures
from tests.stress.draws import DTYPES, angles, directions, log_uniform, log_weights, poses, twists, uniform
from tests.stress.measures import of_numbers, of_pose
from tests.stress.sweep import Inputs, Sweep, register

CASES = 256
FEW = 24
POSE = 1e-5
"""Metres and radians that a pose in float32 may be off, in a world of 2 m."""


def _angle(inputs: Inputs) -> Tensor:
    return inputs["twist"][..., 3:].double().norm(dim=-1)


def _to_pi(inputs: Inputs) -> Tensor:
    return math.pi - se3.log(inputs["pose"].double())[..., 3:].norm(dim=-1)


def _draw_twists(dtype: torch.dtype, count: int, generator: torch.Generator) -> Inputs:
    return {"twist": twists(generator, count).to(dtype)}


def _draw_poses(dtype: torch.dtype, generator: torch.Generator) -> Inputs:
    names = ("pose", "other")
    return {name: se3.reproject(poses(generator, CASES)).to(dtype) for name in names}


def _exact_exp(inputs: Inputs) -> Tensor:
    return exact.by_row(exact.transform, inputs["twist"])


def _proper(transform: Tensor) -> Tensor:
    """In float64 and with a rotation block that is one: what a rounded transform stands for."""
    return se3.reproject(transform.double())


def _log_error(got: Tensor, wanted: Tensor, inputs: Inputs) -> Tensor:
    """Of the transform that the logarithm gives back; a twist longer than pi is no logarithm."""
    beyond = (got[..., 3:].double().norm(dim=-1) - math.pi).clamp_min(0.0)
    return torch.maximum(measures.pose(se3.exp(got.double()), wanted), beyond)


def _jacobian(inputs: Inputs) -> Tensor:
    """D exp / d twist, (n, 16, 6), by autograd."""
    twist = inputs["twist"].detach().requires_grad_()
    with torch.enable_grad():
        flat = se3.exp(twist).flatten(1).sum(0)
        rows = [torch.autograd.grad(value, twist, retain_graph=True)[0] for value in flat if value.requires_grad]
    return torch.stack(rows, 1)


def _exact_jacobian(inputs: Inputs) -> Tensor:
    def derivatives(row: list[Any]) -> Any:  # noqa: ANN401  (a matrix of mpmath)
        columns = [exact.derivative(exact.transform, row, along) for along in range(6)]
        # the last row of a transform is constant: autograd knows no derivative of it
        return exact.mp().matrix([[columns[k][i, j] for k in range(6)] for i in range(3) for j in range(4)])

    return exact.by_row(derivatives, inputs["twist"])


def _jacobian_error(got: Tensor, wanted: Tensor, inputs: Inputs) -> Tensor:
    return measures.absolute(got[:, : wanted.shape[1]], wanted[:, : got.shape[1]])


def _log_jacobian(dtype: torch.dtype, inputs: Inputs) -> Tensor:
    """D log(exp(delta) T) / d delta at 0 by autograd, (n, 6, 6); only away from half a turn, where it jumps."""
    delta = inputs["twist"].new_zeros(len(inputs["twist"]), 6, dtype=dtype).requires_grad_()
    with torch.enable_grad():
        found = se3.log(se3.perturb(se3.exp(inputs["twist"].to(dtype)), delta)).sum(0)
        return torch.stack([torch.autograd.grad(value, delta, retain_graph=True)[0] for value in found], 1)


def _draw_mean(dtype: torch.dtype, generator: torch.Generator) -> Inputs:
    count = 24
    centre = poses(generator, CASES)
    spread = log_uniform(generator, CASES, 1, 1, low=1e-9, high=1.0)
    offsets = uniform(generator, CASES, count, 6, low=-1.0, high=1.0) * spread
    group = se3.reproject(se3.perturb(centre[:, None], offsets)).to(dtype)
    weights = torch.softmax(log_weights(generator, CASES, count), -1).to(dtype)
    weights = weights * log_uniform(generator, CASES, 1, low=1e-20, high=1e20).to(dtype)
    return {"group": group, "weights": weights}


def _draw_points(dtype: torch.dtype, generator: torch.Generator) -> Inputs:
    points = uniform(generator, CASES, 8, 3, low=-1.0, high=1.0).to(dtype)
    return {"points": points, **_draw_poses(dtype, generator)}


def _draw_pairs(dtype: torch.dtype, generator: torch.Generator) -> Inputs:
    """Two poses whose rotations differ by any angle, tiny ones and nearly half turns among them."""
    first = poses(generator, CASES)
    turn = angles(generator, CASES)[:, None] * directions(generator, CASES)
    offset = torch.cat((uniform(generator, CASES, 3, low=-1.0, high=1.0), turn), -1)
    second = se3.reproject(se3.perturb(first, offset))
    return {"pose": first.to(dtype), "other": second.to(dtype)}


def _distance(inputs: Inputs) -> Tensor:
    return torch.stack(se3.distance(inputs["pose"], inputs["other"]), -1)


def _wanted_distance(inputs: Inputs) -> Tensor:
    first, second = _proper(inputs["pose"]), _proper(inputs["other"])
    metres = (first[..., :3, 3] - second[..., :3, 3]).norm(dim=-1)
    return torch.stack((metres, so3.log(first[..., :3, :3].mT @ second[..., :3, :3]).norm(dim=-1)), -1)


MOTIONS = 250


def _draw_chain(steps: int, chains: int, generator: torch.Generator) -> Inputs:
    """Motions of up to a millimetre and of tiny to large angles, composed one after the other, again and again.

    Some chains have small ones only, as tracking has.
    """
    size = log_uniform(generator, chains, 1, 1, low=1e-4, high=1.0)
    twist = twists(generator, chains * MOTIONS, 1e-3).reshape(chains, MOTIONS, 6) * size
    return {"motions": se3.exp(twist).float(), "size": size, "steps": steps}


def _chain(inputs: Inputs) -> Tensor:
    motions = inputs["motions"].unbind(1)
    pose = se3.identity((len(inputs["motions"]),), dtype=torch.float32)
    for step in range(inputs["steps"]):
        pose = se3.compose(motions[step % MOTIONS], pose)
    return pose


def _exact_chain(inputs: Inputs) -> Tensor:
    """One turn through the motions that float32 holds, and its power by squaring; in float64, always a rotation."""
    proper = _proper(inputs["motions"])
    base = se3.identity((len(proper),), dtype=torch.float64)
    for motion in proper.unbind(1):
        base = se3.reproject(motion @ base)
    total, left = se3.identity((len(proper),), dtype=torch.float64), int(inputs["steps"]) // MOTIONS
    while left:
        total = se3.reproject(total @ base) if left & 1 else total
        base, left = se3.reproject(base @ base), left >> 1
    return total


def _chain_error(got: Tensor, wanted: Tensor, inputs: Inputs) -> Tensor:
    """The greater of what it is from orthogonal, of 1e-6, and from the right angle, of 1e-4 rad."""
    rotation, right = got[..., :3, :3].double(), wanted[..., :3, :3]
    away = so3.angle(so3.reproject(rotation).mT @ right)
    return torch.maximum(measures.from_orthogonal(rotation) / 1e-6, away / 1e-4)


def _enter() -> None:
    at_pi = "radians from half a turn"
    for name, dtype in DTYPES.items():
        fine = name == "float64"
        limit = 1e-12 if fine else POSE
        twisted = partial(_draw_twists, dtype, CASES)
        if fine and exact.available():
            few = partial(_draw_twists, dtype, FEW)
            register(Sweep(
                "se3-exp-float64", few, lambda i: se3.exp(i["twist"]), _exact_exp, of_pose, limit, "m, rad",
                _angle, "angle",
            ))  # fmt: skip
            register(Sweep(
                "se3-exp-gradient-float64", few, _jacobian, _exact_jacobian, _jacobian_error, 1e-11, "1",
                _angle, "angle",
            ))  # fmt: skip
        if not fine:
            # in float64 these would be held to themselves
            register(Sweep(
                "se3-mean-float32", partial(_draw_mean, dtype), lambda i: se3.mean(i["group"], i["weights"]),
                lambda i: se3.mean(i["group"].double(), i["weights"].double()), of_pose, limit, "m, rad",
                lambda i: i["weights"].double().sum(-1).log10(), "log10 of the weights' sum",
            ))  # fmt: skip
            register(Sweep(
                "se3-apply-float32", partial(_draw_points, dtype), lambda i: se3.apply(i["pose"], i["points"]),
                lambda i: se3.apply(i["pose"].double(), i["points"].double()), of_numbers, limit, "m",
                _to_pi, at_pi,
            ))  # fmt: skip
            register(Sweep(
                "se3-exp-float32", twisted, lambda i: se3.exp(i["twist"]),
                lambda i: se3.exp(i["twist"].double()), of_pose, limit, "m, rad", _angle, "angle",
            ))  # fmt: skip
            register(Sweep(
                "se3-exp-gradient-float32", twisted, _jacobian,
                lambda i: _jacobian({"twist": i["twist"].double()}), _jacobian_error, 1e-5, "1", _angle, "angle",
            ))  # fmt: skip
        posed = partial(_draw_poses, dtype)
        # a rounded rotation is no rotation: what it misses counts for the input, not for the logarithm
        register(Sweep(
            f"se3-log-{name}", posed, lambda i: se3.log(i["pose"]), lambda i: _proper(i["pose"]), _log_error,
            2e-12 if fine else POSE, "m, rad", _to_pi, at_pi,
        ))  # fmt: skip
        register(Sweep(
            f"se3-compose-{name}", posed, lambda i: se3.compose(i["pose"], i["other"]),
            lambda i: _proper(i["pose"].double() @ i["other"].double()), of_pose, limit, "m, rad", _to_pi, at_pi,
        ))  # fmt: skip
        register(Sweep(
            f"se3-inverse-{name}", posed, lambda i: se3.inverse(i["pose"]) @ i["pose"],
            lambda i: se3.identity((CASES,), dtype=torch.float64), of_pose, limit, "m, rad", _to_pi, at_pi,
        ))  # fmt: skip
        register(Sweep(
            f"se3-distance-{name}", partial(_draw_pairs, dtype), _distance, _wanted_distance, of_numbers,
            1e-12 if fine else POSE, "m, rad",
            lambda i: math.pi - _wanted_distance(i)[..., 1], at_pi,
        ))  # fmt: skip
    register(Sweep(
        "se3-log-gradient-float32", partial(_draw_twists, torch.float32, CASES),
        lambda i: _log_jacobian(torch.float32, _below_pi(i)), lambda i: _log_jacobian(torch.float64, _below_pi(i)),
        of_numbers, 1e-3, "1", _angle, "angle",
    ))  # fmt: skip
    for steps, chains, slow in ((10**4, 32, False), (10**6, 32, True)):
        register(Sweep(
            f"se3-{steps:.0e}-compositions-float32".replace("e+0", "e"), partial(_draw_chain, steps, chains),
            _chain, _exact_chain, _chain_error, 1.0, "of 1e-6 and 1e-4 rad",
            lambda i: i["size"].flatten(), "size of the motions", slow=slow,
        ))  # fmt: skip


def _below_pi(inputs: Inputs) -> Inputs:
    """The same twists, their angles below 3 rad: at half a turn the logarithm has no derivative."""
    twist = inputs["twist"].double()
    angle = twist[..., 3:].norm(dim=-1, keepdim=True)
    return {"twist": torch.cat((twist[..., :3], twist[..., 3:] * (3.0 / angle.clamp_min(3.0))), -1).float()}


_enter()
