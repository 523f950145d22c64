"""What a tip's path and its contact tell of a pushed object's end at best: importance sampling, without a filter.

Many starts are drawn of what is known of the start, with draws of the push density's parameters and shifts each, and
pushed along the whole path; contact weighs them. No resampling, no moves: of enough draws the weighted ends are the
exact posterior under the push density, so that no filter with this push model can do better on average.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.dynamics.along_path import distance_to, push_along_path
from rumi.dynamics.push_density import PushPrediction
from rumi.dynamics.push_posterior import PushPosterior
from rumi.dynamics.push_registration import as_tracked, put_right
from rumi.dynamics.pushed_body import ObservedPush, PushedBody
from rumi.dynamics.tracked_push import way_of

_OUTLIERS = 1e-4


class Contact(NamedTuple):
    """Sensor model of a contact that is felt all along.

    Attributes:
        deviation_m: of the gap between tip and object.
        first: independent readings that the first instant is worth, and
        each: every other one.
    """

    deviation_m: float = 0.001
    first: float = 1.0
    each: float = 0.2


@torch.no_grad()
def weighed_ends(
    push: ObservedPush,
    starts: Float[Tensor, "N 3"],
    believed: PushPosterior,
    body: PushedBody,
    contact: Contact,
    random: torch.Generator,
) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N"]]:
    """Draws of the pose at the end of a push, and their normalised log-weights by the contact.

    Args:
        push: whose path is known; its poses are not looked at.
        starts: drawn of what is known of the start.
        believed: push density; its particles are taken in turn, as often each.
        body: object and tip.
        contact: what is felt.
        random: of the residual.
    """
    count = len(starts)
    particle = believed.thinned(count)
    sliding, shifts, own = particle._known(body.support, starts)
    path = push.path.expand(count, -1, -1).clone()
    path[..., :2] += shifts[:, None, :2]
    right = put_right(starts, shifts)
    first = distance_to(right, path[:, 0], body.pusher, body.outline)
    pushed = push_along_path(right, path, body.pusher, body.outline, sliding, substeps=1)
    gap = torch.cat((first[:, None], pushed.distance), 1) / contact.deviation_m
    worth = torch.full_like(gap[0], contact.each)
    worth[0] = contact.first
    touches = (_OUTLIERS + (1.0 - _OUTLIERS) * (-0.5 * gap.square()).exp()).log() @ worth
    ends = as_tracked(pushed.track[:, -1], shifts)
    scale = own * believed.residual.scale(way_of(starts, ends, body.support))
    way = push.path[-1] - push.path[0]
    heading = torch.atan2(way[1], way[0])[None]
    one = torch.zeros(1, dtype=ends.dtype)
    shown = PushPrediction(ends[:, None], one, scale[:, None], heading, body.support, believed.residual)
    return shown.sample(1, random)[:, 0], touches.log_softmax(-1)
