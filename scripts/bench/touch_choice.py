"""A choice of the next touch, to time decisions on: a rectangle on a table, pokes along its particles' normals."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rumi.information.contact_gain import expected_divergence, with_kinds
from rumi.planning.anytime import Candidate, in_descending_posterior
from rumi.robot.motion_time import SpeedLimits, poke_time
from rumi.seeding import split
from sensors.touch.touch_likelihood import TouchNoise, box_log_likelihoods

_HALF = torch.tensor([0.1, 0.05])
_STANDOFF_M = 0.08
_DEPTH_M = 0.04
_ALONG = torch.tensor([-0.6, 0.0, 0.6])


class Poke(NamedTuple):
    """A straight motion towards a surface.

    Attributes:
        start: (2,), in front of it.
        end: (2,), behind it.
    """

    start: Float[Tensor, "2"]
    end: Float[Tensor, "2"]


@dataclass(frozen=True)
class TouchChoice:
    """What is believed of a rectangle, and where the tool is.

    Attributes:
        states: (x, y, yaw) of particles.
        log_weights: of them.
        tool: (2,), metres.
        readings: drawn for each poke, of which the gain is the mean.
        limits: of all motions.
        noise: of the readings.
    """

    states: Float[Tensor, "N 3"]
    log_weights: Float[Tensor, "N"]
    tool: Float[Tensor, "2"]
    readings: int = 50
    limits: SpeedLimits = field(default_factory=SpeedLimits)
    noise: TouchNoise = field(default_factory=TouchNoise)

    @classmethod
    def drawn(cls, seed: int, *, particles: int = 500, limits: SpeedLimits | None = None) -> "TouchChoice":
        """A belief after a touch or two: spread by centimetres and tens of degrees."""
        random = split(seed, "touch-choice")
        spread = torch.tensor([0.03, 0.03, 0.4]) * (0.5 + torch.rand(3, generator=random))
        states = spread * torch.randn(particles, 3, generator=random)
        log_weights = (-torch.rand(particles, generator=random).log()).log()
        way = 0.3 * (2.0 * torch.rand(2, generator=random) - 1.0)
        tool = way + torch.tensor([0.25, 0.0])
        return cls(states, log_weights.log_softmax(-1), tool, limits=limits or SpeedLimits())

    def candidates(self) -> Iterator[Candidate[Poke]]:
        """Twelve pokes for each particle, three a side, the likeliest particle first."""
        return in_descending_posterior(self.log_weights, self.of_particle)

    def of_particle(self, index: int) -> list[Candidate[Poke]]:
        """The pokes that aim at one particle's sides."""
        out = torch.tensor([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
        along = out.flip(-1).abs()[:, None] * _ALONG[:, None]
        foot = ((out[:, None] + along) * _HALF).reshape(-1, 2)
        out = out.repeat_interleave(len(_ALONG), 0)
        turn, place = _turn(self.states[index, 2]), self.states[index, :2]
        start, end = (place + (foot + far * out) @ turn.mT for far in (_STANDOFF_M, -_DEPTH_M))
        seconds = poke_time(self.tool, start, end, self.limits).tolist()
        work = float(self.readings * len(self.states))
        return [Candidate(Poke(start[k], end[k]), seconds[k], work) for k in range(len(seconds))]

    def gain(self, poke: Poke) -> float:
        """Expected divergence of a poke, nats, from drawn readings; contact anywhere on its way, or none."""
        share, normal, hit = self._meets(poke)
        # the same poke has the same readings
        random = torch.Generator().manual_seed(int(1e6 * float(poke.end.abs().sum())))
        index = torch.multinomial(self.log_weights.exp(), self.readings, replacement=True, generator=random)
        touched = poke.start + share[index, None] * (poke.end - poke.start)
        touched = touched + self.noise.point_m * torch.randn(touched.shape, generator=random)
        felt = normal[index] + self.noise.normal_rad * torch.randn(touched.shape, generator=random)
        felt = felt / felt.norm(dim=-1, keepdim=True)
        turn = _turn(self.states[:, 2])
        own = (touched[:, None] - self.states[:, :2])[..., None, :] @ turn
        facing = felt[:, None, None, :] @ turn
        log = box_log_likelihoods(own[..., 0, :], facing[..., 0, :], _HALF, self.noise)
        # a state that the poke misses leads to no contact surely: a reading too
        log = with_kinds(torch.where(hit[index, None], log, 0.0), hit[index].long(), hit.long())
        return float(expected_divergence(self.log_weights, log))

    def _meets(self, poke: Poke) -> tuple[Float[Tensor, "N"], Float[Tensor, "N 2"], Bool[Tensor, "N"]]:
        """How far along a poke meets the rectangle of each particle, its normal there, and whether it does."""
        turn = _turn(self.states[:, 2])
        start = ((poke.start - self.states[:, :2])[:, None] @ turn)[:, 0]
        way = ((poke.end - poke.start) @ turn).reshape(-1, 2)
        safe = torch.where(way.abs() < 1e-9, 1e-9, way)
        enter = torch.minimum((-_HALF - start) / safe, (_HALF - start) / safe)
        leave = torch.maximum((-_HALF - start) / safe, (_HALF - start) / safe)
        share, axis = enter.max(-1)
        hit = (share <= leave.amin(-1)) & (share >= 0) & (share <= 1)
        normal = torch.zeros_like(way).scatter_(1, axis[:, None], -safe.gather(1, axis[:, None]).sign())
        return share.clamp(0.0, 1.0), (turn @ normal[..., None])[..., 0], hit


def _turn(yaw: Float[Tensor, "*b"]) -> Float[Tensor, "*b 2 2"]:
    """Rotation of a yaw."""
    cos, sin = yaw.cos(), yaw.sin()
    return torch.stack((torch.stack((cos, -sin), -1), torch.stack((sin, cos), -1)), -2)
