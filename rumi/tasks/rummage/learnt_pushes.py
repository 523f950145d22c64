"""Push parameters learnt within a run: the posterior after all pushes so far whose outcome was measured or seen again.

It is worked out anew after each touch, from its prior, since the poses that the pushes began and ended at are the
present belief's: what the first beliefs were off is no error of the push model.
"""

import torch

from rumi.belief.measured_pushes import measured_pushes
from rumi.dynamics.push_posterior import PushPosterior
from rumi.dynamics.pushed_body import PushedBody
from rumi.records import StepRecord

_PUSHES = 12  # the latest that are learnt from: more tell little, and each takes its time
_SPREAD_M = 0.01  # of the believed position beyond which its best pose tells nothing of a push


def learnt_pushes(
    prior: PushPosterior, history: tuple[StepRecord, ...], body: PushedBody, *, generator: torch.Generator
) -> PushPosterior:
    """The posterior after the pushes of a run.

    Args:
        prior: before the run.
        history: the records so far, the first view first.
        body: the object and the tool.
        generator: of the random draws.
    """
    belief = history[-1].belief
    places = belief.world_T_object[:, :2, 3]
    weights = belief.log_weights.softmax(-1)
    spread = (weights @ (places - weights @ places).square().sum(-1)).sqrt()
    if not float(spread) <= _SPREAD_M:
        return prior
    found = measured_pushes([(record.belief, record.reading) for record in history])[-_PUSHES:]
    return prior.update(found, body, generator) if found else prior
