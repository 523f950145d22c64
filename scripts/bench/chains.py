"""Long chains over poses: a reference for SE(3), where no grid is fine enough."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rumi.registration.descent import Search, retract
from sdf import se3, so3

LogDensity = Callable[[Float[Tensor, "N 4 4"]], Float[Tensor, "N"]]


@dataclass(frozen=True)
class ChainSettings:
    """How chains are run.

    Attributes:
        chains: independent ones, each started elsewhere.
        inverse_temperatures: of the tempered copies of a chain; the first, 1, is the target.
        burn_in: steps in which the proposals adapt, then forgotten.
        steps: that count.
        thin: steps between kept poses.
        anywhere: share of proposals that draw the orientation, and half of the time the place, from the prior.
    """

    chains: int = 4
    inverse_temperatures: tuple[float, ...] = (1.0, 0.6, 0.36, 0.2, 0.1, 0.05, 0.02)
    burn_in: int = 4000
    steps: int = 20000
    thin: int = 10
    anywhere: float = 0.2


class Chains(NamedTuple):
    """What the target's chains visited.

    Attributes:
        poses: (C, S, 4, 4).
        accepted: share of the target's local proposals that were taken.
        swapped: (B - 1,), share of the swaps between neighbouring temperatures that were taken.
    """

    poses: Float[Tensor, "C S 4 4"]
    accepted: float
    swapped: Float[Tensor, "B1"]


def tempered_chains(
    log_density: LogDensity,
    low: Float[Tensor, "3"],
    high: Float[Tensor, "3"],
    search: Search,
    settings: ChainSettings,
    *,
    generator: torch.Generator,
) -> Chains:
    """Parallel tempering under an even prior on a box of places (in SE(2) of one height) and all orientations.

    Every chain holds a copy at each temperature; a step proposes a local move or one to anywhere, takes it by
    Metropolis' rule, and then swaps neighbouring temperatures. Local moves are normal with the covariance of what
    the copies of a temperature visited so far, and are scaled until a third is taken; both stop with the burn-in.

    Args:
        log_density: of poses (N, 4, 4), nats, up to a constant.
        low: corner of the box, metres.
        high: the opposite one.
        search: freedom of the pose.
        settings: see there.
        generator: all randomness.
    """
    beta = torch.tensor(settings.inverse_temperatures, dtype=torch.float64)
    levels, chains = len(beta), settings.chains
    size = 3 if search == "SE(2)" else 6

    def draw(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    def from_prior() -> Float[Tensor, "B C 4 4"]:
        place = low + (high - low) * draw(levels, chains, 3)
        return se3.make(_orientations(search, (levels, chains), generator), place)

    pose = from_prior()
    log = log_density(pose.reshape(-1, 4, 4)).reshape(levels, chains)
    spread = torch.eye(size, dtype=torch.float64).mul(0.01).expand(levels, size, size).clone()
    scale = torch.full((levels,), 0.5, dtype=torch.float64)
    history: list[Tensor] = []
    kept, taken, tries, swaps, meetings = [], 0.0, 0, torch.zeros(levels - 1), 0
    for step in range(settings.burn_in + settings.steps):
        noise = torch.randn(levels, chains, size, generator=generator, dtype=torch.float64)
        move = (spread @ noise.mT).mT * scale[:, None, None]
        proposal = retract(pose, move, search)
        anew = from_prior()
        same_place = draw(levels, chains) < 0.5
        anew[..., :3, 3] = torch.where(same_place[..., None], pose[..., :3, 3], anew[..., :3, 3])
        anywhere = draw(levels, chains) < settings.anywhere
        proposal = torch.where(anywhere[..., None, None], anew, proposal)
        place = proposal[..., :3, 3]
        inside = ((place >= low - 1e-12) & (place <= high + 1e-12)).all(-1)
        other = log_density(proposal.reshape(-1, 4, 4)).reshape(levels, chains)
        accepted = inside & (draw(levels, chains).log() < beta[:, None] * (other - log))
        pose, log = torch.where(accepted[..., None, None], proposal, pose), torch.where(accepted, other, log)
        taken += float(accepted[0][~anywhere[0]].sum())
        tries += int((~anywhere[0]).sum())
        if step < settings.burn_in:
            local = accepted.double().where(~anywhere, torch.tensor(0.33, dtype=torch.float64)).mean(-1)
            scale = (scale * torch.exp((local - 0.33) * 20.0 / (20.0 + step) ** 0.6)).clamp(1e-4, 10.0)
            history.append(pose)
            if step % 500 == 499:
                spread = _factors(torch.stack(history[len(history) // 2 :], 2), search)
                if step < settings.burn_in // 2:
                    scale = torch.full_like(scale, 0.5)
            if step == settings.burn_in - 1:
                taken, tries, swaps, meetings = 0.0, 0, torch.zeros(levels - 1), 0
        # even pairs and odd pairs of temperatures in turn
        for level in range(step % 2, levels - 1, 2):
            gain = (beta[level] - beta[level + 1]) * (log[level + 1] - log[level])
            swap = draw(chains).log() < gain
            swaps[level] += swap.double().mean()
            pair = [level, level + 1]
            pose[pair] = torch.where(swap[None, :, None, None], pose[pair[::-1]], pose[pair])
            log[pair] = torch.where(swap[None], log[pair[::-1]], log[pair])
        meetings += 1
        if step >= settings.burn_in and step % settings.thin == 0:
            kept.append(pose[0].clone())
    return Chains(torch.stack(kept, 1), taken / max(1, tries), 2 * swaps / max(1, meetings))


def split_r_hat(values: Float[Tensor, "C S D"]) -> Float[Tensor, "D"]:
    """Gelman and Rubin's R-hat of each coordinate, every chain cut in two; 1 where all halves agree."""
    half = values.shape[1] // 2
    parts = torch.cat((values[:, :half], values[:, half : 2 * half]))
    within = parts.var(1).mean(0)
    between = half * parts.mean(1).var(0)
    return (((half - 1) / half * within + between / half) / within.clamp_min(1e-300)).sqrt()


def effective_size(values: Float[Tensor, "C S D"]) -> Float[Tensor, "D"]:
    """Number of independent draws that the chains' mean of each coordinate is worth (Geyer's initial sequence)."""
    chains, count, size = values.shape
    centred = values - values.mean(1, keepdim=True)
    spectrum = torch.fft.rfft(centred, 2 * count, dim=1)
    covariance = torch.fft.irfft(spectrum.abs().square(), 2 * count, dim=1)[:, :count] / count
    within = covariance[:, 0].mean(0) * count / (count - 1)
    total = within * (count - 1) / count + values.mean(1).var(0) if chains > 1 else within
    correlation = 1.0 - (within - covariance.mean(0) * count / (count - 1)) / total
    pairs = correlation[: count // 2 * 2].reshape(-1, 2, size).sum(1)
    pairs = torch.cummin(pairs, 0).values
    positive = (pairs > 0).cummin(0).values
    time = (2.0 * (pairs * positive).sum(0) - 1.0).clamp_min(1.0 / count)
    return (chains * count / time).clamp_max(chains * count)


def coordinates(poses: Float[Tensor, "*b 4 4"], search: Search) -> Float[Tensor, "*b D"]:
    """Numbers whose convergence is looked at: the place, and the entries of the rotation that can change."""
    place, rotation = poses[..., :3, 3], poses[..., :3, :3]
    if search == "SE(2)":
        return torch.cat((place[..., :2], rotation[..., :2, 0]), -1)
    return torch.cat((place, rotation.flatten(-2)), -1)


def folded(
    poses: Float[Tensor, "*b 4 4"], symmetries: Float[Tensor, "K 3 3"], like: Float[Tensor, "3 3"]
) -> Float[Tensor, "*b 4 4"]:
    """The same poses of a symmetric object, by the rotation among its equals that is nearest to `like`."""
    equals = poses[..., None, :3, :3] @ symmetries.to(poses)
    nearest = (equals * like).sum((-2, -1)).argmax(-1)
    chosen = torch.gather(equals, -3, nearest[..., None, None, None].expand(*nearest.shape, 1, 3, 3))[..., 0, :, :]
    return se3.make(chosen, poses[..., :3, 3])


def _orientations(search: Search, shape: tuple[int, ...], generator: torch.Generator) -> Float[Tensor, "*b 3 3"]:
    """Drawn evenly."""
    if search == "SE(2)":
        angle = 2 * torch.pi * torch.rand(*shape, generator=generator, dtype=torch.float64)
        zero = torch.zeros_like(angle)
        return so3.exp(torch.stack((zero, zero, angle), -1))
    # the rotation of a normal quaternion is an even one
    w, x, y, z = torch.nn.functional.normalize(
        torch.randn(*shape, 4, generator=generator, dtype=torch.float64), dim=-1
    ).unbind(-1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def _factors(poses: Float[Tensor, "B C S 4 4"], search: Search) -> Float[Tensor, "B D D"]:
    """Factors of the covariance of small moves between what the copies of a temperature visited in turn.

    Of moves to a neighbour in time, not about a mean, which says nothing where there are several modes.
    """
    lag = max(1, poses.shape[2] // 50)
    first, second = poses[:, :, :-lag], poses[:, :, lag:]
    shift = second[..., :3, 3] - first[..., :3, 3]
    turn = so3.log(second[..., :3, :3] @ first[..., :3, :3].mT)
    near: Bool[Tensor, "B C S"] = turn.norm(dim=-1) < 0.7
    moves = torch.cat((shift[..., :2], turn[..., 2:]) if search == "SE(2)" else (shift, turn), -1)
    moves = (moves * near[..., None]).flatten(1, 2)
    covariance = moves.mT @ moves / near.flatten(1).sum(-1).clamp_min(1)[:, None, None]
    return torch.linalg.cholesky(covariance + 1e-10 * torch.eye(moves.shape[-1], dtype=torch.float64))
