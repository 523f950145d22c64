"""A particle filter for learning: poses that stay, weighed by any evidence, with the log evidence and its gradient."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from rumi.belief.particles import PoseBelief
from rumi.resampling import resample_systematic
from rumi.seeding import Generators
from rumi.weights import equal_weights, resampled_weights
from sdf import se3
from sensors.evidence import Evidence

Resampler = Callable[[Tensor, Tensor], Any]
"""Of states (*b, N, D) and log-weights (*b, N): the states drawn, their log-weights, and anything more; a module of
PyDPF's is one."""

Move = Callable[[PoseBelief], PoseBelief]


class SystematicResampler(nn.Module):
    """Systematic resampling whose weights keep their slope (stop-gradient resampling, arXiv 2106.10314).

    Gradients go to the weights that were drawn by, so that those of expectations are unbiased but for which particles
    were drawn; states keep theirs.

    Args:
        generator: of the draws; a sequence has one a scene.
    """

    def __init__(self, generator: Generators) -> None:
        super().__init__()
        self.generator = generator

    def forward(
        self, states: Float[Tensor, "*b N D"], log_weights: Float[Tensor, "*b N"]
    ) -> tuple[Float[Tensor, "*b N D"], Float[Tensor, "*b N"]]:
        """States drawn by their weights, with equal weights."""
        index = resample_systematic(log_weights.detach(), generator=self.generator)
        return _drawn(states, index), resampled_weights(log_weights, index)


class SoftResampler(nn.Module):
    """Soft resampling (arXiv 1805.08975): draws by a mixture with equal weights, and weighs what that leaves out.

    A weight after it is w / q of what was drawn by q = a w + (1 - a) / N, with its slope; the slope of the draws by q
    is left out, which biases gradients: the less, the smaller a is, and the draws are then the worse.

    Args:
        generator: of the draws; a sequence has one a scene.
        share: a, of the weights in the mixture, above 0 and at most 1.

    Raises:
        ValueError: the share is none.
    """

    def __init__(self, generator: Generators, share: float = 0.5) -> None:
        super().__init__()
        if not 0 < share <= 1:
            raise ValueError(f"Expected share above 0 and at most 1, got {share}")
        self.generator, self.share = generator, share

    def forward(
        self, states: Float[Tensor, "*b N D"], log_weights: Float[Tensor, "*b N"]
    ) -> tuple[Float[Tensor, "*b N D"], Float[Tensor, "*b N"]]:
        """States drawn by the mixture, with the weights that are left."""
        log_weights = log_weights.log_softmax(-1)
        mixture = log_weights + math.log(self.share)
        if self.share < 1:
            mixture = torch.logaddexp(mixture, equal_weights(log_weights) + math.log1p(-self.share))
        index = resample_systematic(mixture.detach(), generator=self.generator)
        return _drawn(states, index), (log_weights - mixture).gather(-1, index).log_softmax(-1)


class EvidenceInfo(NamedTuple):
    """Diagnostics of a step.

    Attributes:
        ess: (*b), effective sample size before resampling.
        resampled: (*b), whether the scene was resampled.
    """

    ess: Float[Tensor, "*b"]
    resampled: Bool[Tensor, "*b"]


class EvidenceFilter(nn.Module):
    """Particle filter of poses that weighs them by a list of evidence and returns its log evidence.

    Gradients of the log evidence and of the weights go to the numbers of the evidence, through all steps; through a
    resampling as the resampler has it; through a move as the move has it. Poses drawn have the slope of those that they
    were drawn from. Which are drawn, and when, has none.

    Args:
        resampler: see `Resampler`; what changes the states, such as a transport, is put back into SE(3).
        trigger: scenes whose effective sample size is below this share of the particles are resampled, those alone.
        move: of the belief after each step, such as noise or a Markov chain's move; by default poses stay.

    Raises:
        ValueError: the trigger is no share.
    """

    def __init__(self, resampler: Resampler, *, trigger: float = 0.5, move: Move | None = None) -> None:
        super().__init__()
        if not 0 <= trigger <= 1:
            raise ValueError(f"Expected trigger to be a share of the particles, 0 to 1, got {trigger}")
        self.resampler, self.trigger, self.move = resampler, trigger, move

    def forward(
        self, belief: PoseBelief, evidence: Sequence[Evidence]
    ) -> tuple[PoseBelief, Float[Tensor, "*b"], EvidenceInfo]:
        """The belief after some evidence, and the log of what the belief before expected of it.

        Args:
            belief: before; any batch of scenes.
            evidence: independent given the pose, in the frame that rides with the object; each is taken in once.

        Raises:
            DegenerateBeliefError: no particle of a scene explains the evidence.
        """
        log = belief.log_weights
        for one in evidence:
            log = log + one.log_likelihood(belief.attached_T_object)
        belief = belief.reweighted(log)
        ess = belief.ess().detach()
        rows = ess < self.trigger * log.shape[-1]
        if bool(rows.any()):
            belief = self._resampled(belief, rows)
        if self.move is not None:
            belief = self.move(belief)
        return belief, log.logsumexp(-1), EvidenceInfo(ess, rows)

    def _resampled(self, belief: PoseBelief, rows: Bool[Tensor, "*b"]) -> PoseBelief:
        """The belief with the scenes `rows` resampled; draws are made for all, so that a scene's stay its own."""
        poses, log = belief.attached_T_object, belief.log_weights
        states, weights, *_ = self.resampler(poses.flatten(-2), log)
        drawn = states.reshape(*states.shape[:-1], 4, 4)
        if not isinstance(self.resampler, SystematicResampler | SoftResampler):  # of states that may be mixtures
            drawn = se3.reproject(drawn)
        return replace(
            belief,
            attached_T_object=torch.where(rows[..., None, None, None], drawn, poses),
            log_weights=torch.where(rows[..., None], weights.log_softmax(-1), log),
        )


def _drawn(states: Tensor, index: Tensor) -> Tensor:
    return states.gather(-2, index[..., None].expand(*index.shape, states.shape[-1]))
