"""What of a plan's gain over standing still is left on other lattices, by push model and by whether the tool touches.

python -m scripts.plan_lattices run
python -m scripts.plan_lattices show

A plan is searched for with 16 times the samples on the usual lattice of 10 mm, and judged on it, on the same one half a
cell further along x and y, and on ones of 5 and 2.5 mm, the pads' points half a cell apart at most: all that
the displacement model looks up is on the lattice, and nothing of what the quasi-static one does. 2000 random plans say
how alike two lattices judge, and how many of the first actions move the tool at all. Beliefs are those of recorded
readings of mug-1 after its handle was felt (`scripts.bench.situations`), as they are and with the tool 20 mm farther
from the mug, and of runs of the mugs after the first touch and before the last action.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple, cast

import torch
from jaxtyping import Float
from torch import Tensor

from kmppi import MPPI
from rumi.belief.particles import PoseBelief
from rumi.cache import cache_folder
from rumi.cli import script
from rumi.clock import Clock
from rumi.fields.information import information_field
from rumi.fields.workspace import Workspace
from rumi.planning.objective import TrajectoryCost, sensing_points, without
from rumi.planning.policy import PlanRequest, Scene
from rumi.planning.rummaging import RummagingPolicy, RummagingSettings
from rumi.resampling import systematic
from rumi.robot.reach import Reach
from rumi.robot.reach_table import ReachSettings
from rumi.robot.tool import Tool
from rumi.tasks.rummage.build import build, reachability
from rumi.tasks.rummage.scene_spec import TaskSpec
from rumi.tasks.rummage.scenes import find_task
from rumi.tasks.rummage.settings import preset
from scripts.bench.situations import follow, situation
from scripts.experiment import Experiment, Line
from scripts.reproduce.cells import table
from sdf.grid_sdf import GridSDF
from sdf.object_model import ObjectModel
from sdf.voxel_grid import VoxelGrid

LATTICES = {"10 mm": (0.010, 0.0), "10 mm, shifted": (0.010, 0.005), "5 mm": (0.005, 0.0), "2.5 mm": (0.0025, 0.0)}
"""Spacing and shift along x and y, metres."""

USUAL = "10 mm"
RECORDED, BACKED = "mug-1, recorded", "mug-1, recorded, tool 20 mm back"
WHEN = ("first touch", "last")
BELIEFS = (RECORDED, BACKED, *(f"mug-{k}, {when}" for k in range(3) for when in WHEN))
MODELS = ("displacement", "quasi-static")
TIMES, RANDOM = (16, 1), 2000


class Given(NamedTuple):
    """What a plan is made from.

    Attributes:
        task: whose bounds and arm they are.
        model: the object.
        tool: that plans.
        belief: of where the object is.
        configuration: of the tool.
    """

    task: str
    model: ObjectModel
    tool: Tool
    belief: PoseBelief
    configuration: Float[Tensor, "3"]

    def workspace(self, lattice: str) -> Workspace:
        """One of `LATTICES`."""
        spec, (spacing, shift) = find_task(self.task), LATTICES[lattice]
        corners = torch.tensor([(x + shift, y + shift, spec.height_m) for x, y in spec.bounds])
        return Workspace.from_bounds(corners, spacing, planar_height=spec.height_m)


@torch.no_grad()
def given(belief: str, seed: int) -> Given:
    """The belief of a name."""
    if belief in (RECORDED, BACKED):
        recorded = situation("mug-1", "handle")
        model, here = recorded.spec.object_factory(), recorded.readings[-1].configuration
        poses = evenly(follow(recorded, cast(GridSDF, model.sdf), particles=1000, seed=seed).belief, 100)
        if belief == BACKED:
            away = here[:2] - poses.weights @ poses.world_T_object[:, :2, 3]
            here = torch.cat((here[:2] + 0.02 * away / away.norm(), here[2:]))
        return Given("mug-1", model, tool_of(recorded.spec), poses, here)
    task, when = belief.split(", ")
    with build(preset(task=task, conditions="ideal"), cache_dir=cache_folder()) as (world, agent):
        state = agent.begin(world.reset(seed), seed=seed, clock=Clock())
        while agent.stop(state) is None and not (when == WHEN[0] and state.record.contacts):
            state, control = agent.act(state)
            before, state = state, agent.update(state, control, world.step(control))
        record = (state if when == WHEN[0] else before).record
        return Given(task, agent.model, agent.tool, record.belief, record.reading.configuration)


def evenly(belief: PoseBelief, count: int) -> PoseBelief:
    """The belief with fewer particles, evenly by weight."""
    index = systematic(belief.log_weights, 0.5, count)
    return replace(
        belief,
        attached_T_object=belief.attached_T_object[index],
        log_weights=torch.log_softmax(belief.log_weights.new_zeros(count), -1),
        discrepancy=belief.discrepancy[index],
    )


def tool_of(spec: TaskSpec) -> Tool:
    """The task's tool, its information points 5 mm apart."""
    reach = Reach.of_arm(spec.base, ReachSettings(height_m=spec.height_m), cache_dir=cache_folder())
    return Tool(torch.tensor(spec.bounds), reach, height_m=spec.height_m, info_spacing_m=0.005)


class Judged(NamedTuple):
    """What plans promise on a lattice.

    Attributes:
        information: (K,), share of all there is, worth less the later.
        left: (K,), the same without the cells that the pads are in at the start.
        reach: (K,), weighed.
        moves: (K,), share of rollouts whose first action moves the tool.
    """

    information: Float[Tensor, "K"]
    left: Float[Tensor, "K"]
    reach: Float[Tensor, "K"]
    moves: Float[Tensor, "K"]


@torch.no_grad()
def judged(
    here: Given, push_model: str, lattice: str, controls: Float[Tensor, "K H 3"], rollouts: int | None = None
) -> Judged:
    """Parts of the planner's cost of control sequences, by as many rollouts as the model's default unless given."""
    own, belief = RummagingSettings(push_model=push_model), here.belief
    suited, workspace = own.suited(push_model), here.workspace(lattice)
    poses, log_weights = belief.world_T_object, belief.log_weights
    tool = finer(here.tool, 0.5 * workspace.spacing)
    fields = information_field(here.model.sdf, poses, log_weights, workspace.points, own.information)
    models = RummagingPolicy(None, replace(own, reachability_scale=0.0)).push_models
    model = models.rollouts(here.model, poses, log_weights, tool, workspace, fields)
    rolled = model.rollout(
        here.configuration, controls, rollouts=rollouts or suited.rollouts, generator=torch.Generator().manual_seed(0)
    )
    found, sensing = workspace.grid(fields.information), sensing_points(tool, fields.information)
    rest, total = without(found, tool.info_points(here.configuration)), float(found.values.sum())
    discount = own.information_discount

    def share(of: VoxelGrid) -> Float[Tensor, "K"]:
        cost = TrajectoryCost(of, None, sensing, reachability_scale=0.0, information_discount=discount)
        return cost(rolled) * (-float(of.values.sum()) / total)

    reach = workspace.grid(reachability(tool, workspace))
    scale = suited.reachability_scale
    kept = -TrajectoryCost(found, reach, sensing, information_scale=0.0, reachability_scale=scale)(rolled)
    moved = torch.diff(rolled.configurations[..., :2, :], dim=-2)[..., 0, :].norm(dim=-1) > 1e-6
    return Judged(share(found), share(rest), kept, moved.float().mean(-1))


def finer(tool: Tool, spacing_m: float) -> Tool:
    """The tool with its pads' points at most so far apart, and no farther than they are."""
    if spacing_m >= 0.005:
        return tool
    return Tool(tool.bounds, tool.reach, shape=tool.shape, height_m=tool.height_m, info_spacing_m=spacing_m)


def searched(here: Given, push_model: str, lattice: str, times: int, seed: int) -> Float[Tensor, "H 3"]:
    """A first plan by some times the samples."""
    own, workspace = RummagingSettings(push_model=push_model), here.workspace(lattice)
    own = replace(own, mppi=replace(own.mppi, samples=times * own.mppi.samples), least_share=0.0)
    tool = finer(here.tool, 0.5 * workspace.spacing)
    scene = Scene(here.model, workspace, tool, here.configuration)
    policy = RummagingPolicy(reachability(tool, workspace), own)
    return policy.act(PlanRequest(here.belief, scene, generator=torch.Generator().manual_seed(seed))).controls


def measure(belief: str, push_model: str, times: int, seed: int) -> dict[str, Any]:
    """What a plan, standing still and random plans promise on each lattice."""
    here, planner = given(belief, seed), MPPI(RummagingSettings().mppi, 3)
    plan = searched(here, push_model, USUAL, times, seed)
    random = torch.Generator().manual_seed(seed)
    noise = planner.noise_variance.sqrt() * torch.randn(RANDOM, planner.parameterization.knots, 3, generator=random)
    every = torch.cat((torch.zeros_like(plan)[None], plan[None], planner.from_knots(noise).controls))
    found = {lattice: judged(here, push_model, lattice, every) for lattice in LATTICES}
    worth = {lattice: of.information + of.reach for lattice, of in found.items()}
    return {
        lattice: {
            "gain": float(worth[lattice][1] - worth[lattice][0]),
            "information": (of.information[1] - of.information[0]).item(),
            "still": float(of.information[0]),
            "still_left": float(of.left[0]),
            "left": float(of.left[1]),
            "moves": float(of.moves[2:].mean()),
            "alike": float(torch.corrcoef(torch.stack((worth[USUAL][2:], worth[lattice][2:])))[0, 1]),
        }
        for lattice, of in found.items()
    }


def show(lines: list[Line], chosen: Mapping[str, Any]) -> str:
    """A row for each belief and model, the mean over seeds."""
    rows = []
    for model in MODELS:
        for belief in BELIEFS:
            own = [line for line in lines if line["belief"] == belief and line["push_model"] == model]
            some, usual = ([line for line in own if line["times"] == times] for times in TIMES)
            if some:
                rows.append([model, belief, str(len(some)), *_row(some), _means(usual, "gain") if usual else ""])
    heads = ["model", "belief", "seeds", "gain on 10; 10 shifted; 5; 2.5 mm", "of it information", "alike to 10 mm"]
    heads += ["first actions that move", "standing still: information; without the pads' cells"]
    return table([*heads, "gain by the usual samples"], rows)


def _row(some: list[Line]) -> list[str]:
    others = tuple(LATTICES)[1:]
    still = (_means(some, of, (USUAL,)) for of in ("still", "still_left"))
    kinds = [_means(some, "gain"), _means(some, "information"), _means(some, "alike", others), _means(some, "moves")]
    return [*kinds, "; ".join(still)]


def _means(some: list[Line], of: str, lattices: Sequence[str] = tuple(LATTICES)) -> str:
    return "; ".join(f"{sum(line[lattice][of] for line in some) / len(some):.2f}" for lattice in lattices)


EXPERIMENT = Experiment(
    __doc__,
    "plan_lattices.jsonl",
    {"belief": BELIEFS, "push_model": MODELS, "times": TIMES},
    measure,
    show,
    seeds="1000-1001",
)

if __name__ == "__main__":
    script(EXPERIMENT.main)
