"""What a reading of any kind is expected to tell: the mean divergence of the posterior from the prior."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor


def divergence(log_weights: Float[Tensor, "*#b N"], log_likelihood: Float[Tensor, "*#b N"]) -> Float[Tensor, "*b"]:
    """KL divergence (*b), nats, of the posterior weights from those before (time allocation, Eq. 6).

    In the form E_post[log L] - log Z, which takes no logarithm of a weight that is 0. A reading that no state explains
    tells nothing: 0.

    Args:
        log_weights: of the states, normalised or not.
        log_likelihood: of the reading at each state, up to a constant; may be -inf.

    Raises:
        ValueError: a weight or a likelihood is NaN or infinite, or no state has any weight.
    """
    joint = log_weights.log_softmax(-1) + log_likelihood
    evidence = joint.logsumexp(-1)
    if bool((evidence.isnan() | (evidence == torch.inf)).any()):
        raise ValueError(
            "Expected log-weights of which one is finite and log-likelihoods that are finite or -inf, got NaN or inf: "
            "are all states, readings and their noise finite, and the noise above 0?"
        )
    possible = torch.isfinite(evidence)
    if joint.requires_grad:
        # a sum of nothing but exp(-inf) has no slope
        joint = torch.where(possible[..., None], joint, 0.0)
        evidence = torch.where(possible, joint.logsumexp(-1), -torch.inf)
    posterior = (joint - torch.where(possible, evidence, 0.0)[..., None]).exp()
    held = (posterior > 0) & possible[..., None]
    mean = torch.where(held, posterior * torch.where(held, log_likelihood, 0.0), 0.0).sum(-1)
    return torch.where(possible, mean - torch.where(possible, evidence, 0.0), 0.0).clamp_min(0.0)


def expected_divergence(
    log_weights: Float[Tensor, "*#b N"],
    log_likelihood: Float[Tensor, "*#b M N"],
    reading_log_weights: Float[Tensor, "*#b M"] | None = None,
) -> Float[Tensor, "*b"]:
    """Divergence (*b), nats, expected over readings (time allocation, Eq. 7), in O(M N) from the likelihoods alone.

    With M = N noise-free readings, one of each state, it is what the paper works out: no mutual information, and off
    to one side or the other by how wide the belief is for the noise. With readings that are drawn, of a state by
    weight and with noise, it is an estimate of the mutual information: take those to compare actions of different
    precision.

    Args:
        log_weights: of the states.
        log_likelihood: of reading j (rows) at state i (columns), up to a constant for each row.
        reading_log_weights: of the readings; by default the states' where M = N, else even.
    """
    readings, states = log_likelihood.shape[-2:]
    if log_weights.shape[-1] != states:
        raise ValueError(f"Expected a likelihood for each of the {log_weights.shape[-1]} states, got {states}")
    if reading_log_weights is None:
        reading_log_weights = log_weights if readings == states else log_weights.new_zeros(readings)
    weights = reading_log_weights.softmax(-1)
    return (weights * divergence(log_weights[..., None, :], log_likelihood)).sum(-1)


def with_misses(
    log_likelihood: Float[Tensor, "*b M N"], reading_hits: Bool[Tensor, "*b M"], state_hits: Bool[Tensor, "*b N"]
) -> Float[Tensor, "*b M N"]:
    """The likelihoods where a motion touches some states and misses others, and that is a reading too.

    A state that the motion misses leads to no contact surely: it explains no reading of a touch, and a reading of no
    contact is explained by all that it misses, and by no other.

    Args:
        log_likelihood: of readings as touches; rows of no contact may hold anything.
        reading_hits: whether each reading is one of a touch.
        state_hits: whether the motion touches the object at each state.
    """
    told = torch.where(reading_hits[..., :, None], log_likelihood, torch.zeros_like(log_likelihood))
    return with_kinds(told, reading_hits.long(), state_hits.long())


def with_kinds(
    log_likelihood: Float[Tensor, "*b M N"], reading_kinds: Int[Tensor, "*b M"], state_kinds: Int[Tensor, "*b N"]
) -> Float[Tensor, "*b M N"]:
    """The likelihoods where readings are of kinds, of which each state leads to one surely, and to no other.

    Args:
        log_likelihood: of the readings, their kind given.
        reading_kinds: any numbers, such as 0 for no contact.
        state_kinds: the kind that each state leads to.
    """
    same = reading_kinds[..., :, None] == state_kinds[..., None, :]
    return torch.where(same, log_likelihood, torch.full_like(log_likelihood, -torch.inf))
