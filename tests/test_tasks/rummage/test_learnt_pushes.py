"""Push parameters learnt within a run: only from motions that tell, and of poses that are known."""

from dataclasses import replace

import torch

from rumi.belief.particles import PoseBelief
from rumi.dynamics.push_posterior import PushPosterior
from rumi.dynamics.pushed_body import PushedBody
from rumi.dynamics.quasi_static import QuasiStaticSettings
from rumi.dynamics.quasi_static_push import QuasiStaticPush
from rumi.robot.gripper import GripperShape
from rumi.tasks.rummage.learnt_pushes import learnt_pushes
from sdf import se3
from sdf.object_model import box_model
from tests.fixtures.made_up_run import make_up
from tests.fixtures.readings import make_reading

RUN = make_up(3, particles=2)


def history(*, spread):
    """A box that goes 40 mm with the tool that touches its near side in one of two steps."""
    shifts = torch.tensor([[-spread, 0.0, 0.0], [spread, 0.0, 0.0]])
    tool = torch.zeros(9, 3)
    tool[:, 0], tool[:, 1] = -0.1 + torch.linspace(0.0, 0.08, 9), 0.05
    found = []
    for step, (record, gone) in enumerate(zip(RUN.steps, (0.0, 0.04, 0.04), strict=False)):
        attached = se3.make(torch.eye(3), torch.tensor([gone, 0.0, 0.0]))
        belief = PoseBelief(attached, se3.make(torch.eye(3), shifts), torch.zeros(2).log_softmax(-1), torch.zeros(2))
        reading = make_reading(tool=se3.from_planar(tool, 0.045), contact=step == 1)
        found.append(replace(record, belief=belief, reading=reading))
    return tuple(found)


def body():
    return PushedBody.of(box_model(spacing=0.004, points=100).sdf, 0.0, GripperShape())


def test_one_push_teaches_and_the_same_history_the_same():
    prior = PushPosterior.prior(16)
    found = [
        learnt_pushes(prior, history(spread=0.0), body(), generator=torch.Generator().manual_seed(0)) for _ in "ab"
    ]
    means = [one.log_weights.exp() @ one.parameters for one in (*found, prior)]
    assert len(found[0].pushes) == 1 and float((means[0] - means[2])[:2].abs().max()) > 1e-3
    assert torch.equal(means[0], means[1])


def test_what_nobody_knows_the_place_of_teaches_nothing():
    prior = PushPosterior.prior(16)
    assert learnt_pushes(prior, history(spread=0.03), body(), generator=torch.Generator()) is prior
    still = tuple(replace(one, reading=make_reading(contact=False)) for one in history(spread=0.0))
    assert learnt_pushes(prior, still, body(), generator=torch.Generator()) is prior


def test_a_model_that_learns_is_another():
    first, learnt = QuasiStaticPush(QuasiStaticSettings()), PushPosterior.prior(4)
    assert first.knowing(learnt).posterior is learnt and first.posterior is None
