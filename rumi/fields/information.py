"""Information field: posterior semantics of every workspace point, and its information about the object's pose."""

import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any, Literal, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rumi.weights import check_weights
from sdf import backend, compiled, gpu, skipped_work
from sdf.base import SDF
from sdf.bounds import Checked, NotNegative, Positive, ShareBelow1
from sdf.check import check_finite, check_shape, is_eager, may_look
from sdf.grid_sdf import takes
from sdf.numbers import Numbers, Range
from sdf.posed import about_first, posed_distance
from sdf.precision import full_precision

InformationMode = Literal["surrogate", "reverse_kl", "forward_kl", "sensor_mi"]

# Pairs (pose, point) that one chunk holds: about 15 temporaries of this many floats live at once.
CHUNK_BYTES = 64 * 2**20

_SHARPNESS = 100.0  # 1/m, of the sensor model


class WorkspaceFields(NamedTuple):
    """Semantics and information of workspace points.

    Attributes:
        semantics: (*b, V, 3), p(free, occupied, surface); sums to 1.
        information: (*b, V), nats, 0 or more.
    """

    semantics: Float[Tensor, "*b V 3"]
    information: Float[Tensor, "*b V"]

    @property
    def contact(self) -> Float[Tensor, "*b V"]:
        """Probability that a point of the robot placed there touches the object: occupied or surface."""
        return self.semantics[..., 1] + self.semantics[..., 2]


@dataclass(frozen=True)
class InformationSettings(Checked):
    """Settings of the information field.

    Attributes:
        mode: `surrogate` is the paper's field (Eq 23), first order in the discrepancy, not zero where all
            poses agree; `reverse_kl` and `forward_kl` are the divergences that it approximates, exact under the
            particles; `sensor_mi` is the mutual information of pose and semantics under the sensor model alone.
        peakiness: lambda of the pose posterior (Eq 10); not used by `sensor_mi`.
        free_scale: C of the free and occupied terms (Eqs 4-5); not used by `sensor_mi`.
        tolerance: metres, 0 or more, by which a free or occupied point may be violated (alpha = -tolerance).
        sharpness: of the sensor model, 1/m; None for 100, and in plans of guarded moves in space for 300.
        surface_tolerance: metres within which the sensor model calls a point surface for sure.
        tail: points that are at most this likely to be surface under every pose are taken as free and void of
            information without being looked up; 0 looks up all.
    """

    mode: InformationMode = "sensor_mi"
    peakiness: NotNegative = 2.0
    free_scale: NotNegative = 10.0
    tolerance: NotNegative = 0.0
    sharpness: Positive | None = None
    surface_tolerance: NotNegative = 0.003
    tail: ShareBelow1 = 1e-6

    def sharpness_of(self) -> float:
        """The sensor model's sharpness, 1/m: what is set, or else 100."""
        return _SHARPNESS if self.sharpness is None else self.sharpness


@full_precision
def information_from_distances(
    distance: Float[Tensor, "*b N V"],
    log_weights: Float[Tensor, "*b N"],
    *,
    mode: InformationMode = "sensor_mi",
    peakiness: float | Tensor = 2.0,
    free_scale: float | Tensor = 10.0,
    tolerance: float | Tensor = 0.0,
    sharpness: float | Tensor = _SHARPNESS,
    surface_tolerance: float | Tensor = 0.003,
) -> WorkspaceFields:
    """Semantics (RUMI, Eq 27) and information of points from their signed distances to every pose.

    With p the mean of the sensor model over the poses and c = (C max(0, -tolerance - v),
    C max(0, -tolerance + v), |v|), the information is, summed over the three semantics s,
    `surrogate`: p_s lambda E[c_s] (Eq 23); `reverse_kl`: p_s (lambda E[c_s] + log E[exp(-lambda c_s)]);
    `forward_kl`: p_s (-lambda E'[c_s] - log E[exp(-lambda c_s)]), E' under weights w exp(-lambda c_s);
    `sensor_mi`: H(p) - E[H(p_i)]. The paper calls the constant of the two divergences intractable; under the
    particles it is the log term above. Its alpha > 0 is a tolerance only with the opposite sign.

    Args:
        distance: signed distance of each point to each pose, metres.
        log_weights: normalised log-weights of the poses.
        mode: see `InformationSettings`, as for the rest.
        peakiness: lambda.
        free_scale: C.
        tolerance: metres.
        sharpness: 1/m.
        surface_tolerance: metres.
    """
    weights = log_weights.exp()[..., None, :]
    excess = (distance.abs() - surface_tolerance).clamp_min(0.0)
    surface = torch.exp(-sharpness * excess)  # the only exponential of a pair
    off_surface = 1.0 - surface

    def mean(values: Tensor) -> Tensor:
        return (weights @ values)[..., 0, :]

    p_surface = mean(surface)
    p_occupied = mean(off_surface * (distance <= 0))
    p_free = mean(off_surface * (distance > 0))
    semantics = torch.stack((p_free, p_occupied, p_surface), -1)
    total = semantics.sum(-1)  # weights sum to 1 up to rounding only
    semantics = semantics / total[..., None]
    if mode == "sensor_mi":
        tiny = torch.finfo(distance.dtype).tiny
        own = sharpness * excess * surface - off_surface * off_surface.clamp_min(tiny).log()
        information = -torch.xlogy(semantics, semantics.clamp_min(tiny)).sum(-1) - mean(own) / total
    else:
        costs = (
            free_scale * (-tolerance - distance).clamp_min(0.0),
            free_scale * (distance - tolerance).clamp_min(0.0),
            distance.abs(),
        )
        information = torch.zeros_like(p_free)
        for s, cost in enumerate(costs):
            found = _divergence(cost * peakiness, log_weights, mode, lambda values: mean(values) / total)
            information = information + semantics[..., s] * found
    return WorkspaceFields(semantics, information.clamp_min(0.0))


def _divergence(cost: Tensor, log_weights: Tensor, mode: InformationMode, mean: Callable[[Tensor], Tensor]) -> Tensor:
    """Information of one outcome whose negative log-likelihood under each pose is `cost` (*b, N, V)."""
    if mode == "surrogate":
        return mean(cost)
    # what all poses have in common says nothing, and would cost digits
    cost = cost - cost.amin(-2, keepdim=True)
    joint = log_weights[..., :, None] - cost
    log_evidence = torch.logsumexp(joint, -2)
    if mode == "reverse_kl":
        return mean(cost) + log_evidence
    return -(torch.softmax(joint, -2) * cost).sum(-2) - log_evidence


@full_precision
def information_field(
    sdf: SDF,
    world_T_object: Float[Tensor, "*b N 4 4"],
    log_weights: Float[Tensor, "*b N"],
    points_w: Float[Tensor, "V 3"],
    settings: InformationSettings | None = None,
    **parameters: float | Tensor,
) -> WorkspaceFields:
    """Semantics and information of world points under a belief, looking up only points that matter.

    A point further than `tail_distance` from the box that holds the object at every pose gets p = (1, 0, 0) and
    no information. What that leaves out: at most `tail` in each probability, and in the information at most
    tail (1 + ln(1 / tail)) nats for `sensor_mi` and peakiness E|v| tail for the others, since such a point is
    outside every pose, has no free-space cost and is surface with at most that probability. `tail` 0 is exact.

    Args:
        sdf: the object's shape.
        world_T_object: (*b, N, 4, 4), poses.
        log_weights: (*b, N), normalised.
        points_w: (V, 3), the same for every scene of a batch.
        settings: of the semantics' sensor model and of what is skipped.
        parameters: override single settings by floats or tensors (gradients reach tensors).

    Raises:
        ValueError: a shape does not fit, a pose is not finite, or weights as `check_weights` refuses them.
    """
    check_shape("world_T_object", world_T_object, "(*b, N, 4, 4)", last=(4, 4))
    check_shape("points_w", points_w, "(V, 3)", last=(3,))
    check_weights(log_weights)
    # one such pose would hide the object from all points, whatever its weight
    check_finite("world_T_object", world_T_object)
    settings = settings or InformationSettings()
    values: dict[str, Any] = {f.name: getattr(settings, f.name) for f in fields(settings)}
    values |= {"sharpness": settings.sharpness_of()} | parameters
    tail = values.pop("tail")
    numbers = [values[name] for name in ("sharpness", "surface_tolerance")]
    if is_eager():
        numbers = [float(torch.as_tensor(value).detach()) for value in numbers]
    reach = tail_distance(numbers[0], numbers[1], tail)
    near = near_object(sdf, world_T_object, points_w, reach)  # (*b, V)
    tensors = (value for value in values.values() if isinstance(value, Tensor))
    version = backend.dispatch("information_field", world_T_object, log_weights, points_w, *sdf.tensors(), *tensors)
    with skipped_work.work("workspace_points") as work:
        if skipped_work.kept():
            work.count(near.sum(), near.numel())
        return version(sdf, world_T_object, log_weights, points_w, near, values)


@backend.register("information_field")
def _information_field(
    sdf: SDF, world_T_object: Tensor, log_weights: Tensor, points_w: Tensor, near: Tensor, values: dict[str, Any]
) -> WorkspaceFields:
    """Fields of the points `near` (*b, V), the others free and void of information."""
    world_T_object, points_w = about_first(world_T_object, points_w)
    batch, count = world_T_object.shape[:-3], world_T_object.shape[-3]
    if not may_look(world_T_object):  # what is traced looks all up
        every = points_w.expand(*batch, *points_w.shape[-2:])
        whole = information_from_distances(posed_distance(sdf, world_T_object, every), log_weights, **values)
        free = points_w.new_tensor([1.0, 0.0, 0.0])
        found = torch.where(near, whole.information, torch.zeros_like(whole.information))
        return WorkspaceFields(torch.where(near[..., None], whole.semantics, free), found)
    some = near.reshape(math.prod(batch), points_w.shape[-2]).any(0).nonzero()[:, 0]
    shape = (*batch, points_w.shape[-2])
    semantics = points_w.new_tensor([1.0, 0.0, 0.0]).expand(*shape, 3).clone()
    information = points_w.new_zeros(shape)
    size = max(1, CHUNK_BYTES // (4 * 16 * max(1, math.prod(batch) * count)))
    for index in some.split(size):
        points = points_w[..., index, :].expand(*batch, len(index), 3)
        here = information_from_distances(posed_distance(sdf, world_T_object, points), log_weights, **values)
        kept = near[..., index]  # a scene of a batch leaves out what it would leave out alone
        semantics[..., index, :] = torch.where(kept[..., None], here.semantics, semantics[..., index, :])
        information[..., index] = torch.where(kept, here.information, information[..., index])
    return WorkspaceFields(semantics, information)


@backend.register("information_field", "numba", compiled.supports)
def _information_field_numba(
    sdf: SDF, world_T_object: Tensor, log_weights: Tensor, points_w: Tensor, near: Tensor, values: dict[str, Any]
) -> WorkspaceFields:
    numbers = {name: value for name, value in values.items() if name != "mode"}
    lone = all(value.numel() == 1 for value in numbers.values() if isinstance(value, Tensor))
    if not lone or not takes(sdf, world_T_object, log_weights, points_w) or not world_T_object.shape[-3]:
        return _information_field(sdf, world_T_object, log_weights, points_w, near, values)
    from rumi.fields.information_numba import information_field as compiled

    world_T_object, points_w = about_first(world_T_object, points_w)
    floats = {name: value.item() if isinstance(value, Tensor) else float(value) for name, value in numbers.items()}
    return WorkspaceFields(*compiled(sdf, world_T_object, log_weights, points_w, near, values["mode"], floats))


@backend.register("information_field", gpu.VERSION, gpu.supports, gpu.suits)
def _information_field_warp(
    sdf: SDF, world_T_object: Tensor, log_weights: Tensor, points_w: Tensor, near: Tensor, values: dict[str, Any]
) -> WorkspaceFields:
    mode, numbers = values["mode"], {name: value for name, value in values.items() if name != "mode"}
    if mode not in ("sensor_mi", "surrogate") or any(isinstance(value, Tensor) for value in numbers.values()):
        return _information_field(sdf, world_T_object, log_weights, points_w, near, values)
    if not takes(sdf, world_T_object, log_weights, points_w):
        return _information_field(sdf, world_T_object, log_weights, points_w, near, values)
    from rumi.fields.information_warp import information_field as compiled

    return WorkspaceFields(*compiled(sdf, world_T_object, log_weights, points_w, near, mode, numbers))


def tail_distance(sharpness: Any, surface_tolerance: Any, tail: float) -> Any:  # noqa: ANN401  (float or Tensor)
    """Distance from the surface, metres, at which the sensor model's p(surface) has fallen to `tail`."""
    return math.inf if tail == 0 else surface_tolerance - math.log(tail) / sharpness


def near_object(
    sdf: SDF, world_T_object: Float[Tensor, "*b N 4 4"], points_w: Float[Tensor, "V 3"], reach: float | Tensor
) -> Bool[Tensor, "*b V"]:
    """Whether a point may lie within `reach` metres of the object at some pose; O(N + V), errs towards yes."""
    low, high = sdf.bounds.to(world_T_object)
    middle = world_T_object[..., :3, :3] @ (0.5 * (low + high)) + world_T_object[..., :3, 3]
    lower, upper = middle.amin(-2)[..., None, :], middle.amax(-2)[..., None, :]
    gap = (torch.maximum(lower - points_w, points_w - upper)).clamp_min(0.0).norm(dim=-1)
    return gap <= reach + 0.5 * (high - low).norm()


class InformationField(Numbers):
    """`information_field` as a module of physical numbers, fixed or trained.

    Args:
        sdf: the object's shape.
        settings: mode, tail, and where the buffers start.
        trainable: train sharpness and surface_tolerance, and where the mode uses them peakiness and free_scale,
            within their range (`sdf.numbers.Numbers`).
    """

    def __init__(self, sdf: SDF, settings: InformationSettings | None = None, *, trainable: bool = False) -> None:
        super().__init__()
        self.sdf = sdf
        self.settings = settings or InformationSettings()
        self._names = ("peakiness", "free_scale", "tolerance", "sharpness", "surface_tolerance")
        used = ["sharpness", "surface_tolerance"]
        if self.settings.mode != "sensor_mi":
            used += ["peakiness", "free_scale"]
        own = replace(self.settings, sharpness=self.settings.sharpness_of())
        for name in self._names:
            self.enter(name, getattr(own, name), Range.POSITIVE if trainable and name in used else None)

    def forward(
        self,
        world_T_object: Float[Tensor, "*b N 4 4"],
        log_weights: Float[Tensor, "*b N"],
        points_w: Float[Tensor, "V 3"],
    ) -> WorkspaceFields:
        """Semantics (*b, V, 3) and information (*b, V) of world points."""
        numbers = {name: getattr(self, name).to(points_w) for name in self._names}
        return information_field(self.sdf, world_T_object, log_weights, points_w, self.settings, **numbers)
