"""The loop of touch alone: belief, choice of a poke, robot, filter, until a grasp is likely to succeed."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rumi.belief.planar_prior import PlanarPrior
from rumi.belief.replay_settings import ReplaySettings
from rumi.belief.touch_belief import TouchAction, TouchBelief
from rumi.belief.trajectory_filter import TouchFilter
from rumi.clock import Clock
from rumi.dynamics.along_path import Carrier, carry
from rumi.dynamics.sliding import Sliding
from rumi.information.entropy import SharedSupport
from rumi.information.neighbours import StateMetric, merged
from rumi.resampling import resample_systematic
from rumi.seeding import split
from rumi.tasks.grasp_table import Grasp, GraspTable, best_grasp
from rumi.tasks.touch_box.candidates import pokes
from rumi.tasks.touch_box.robot import Touched, TouchRobot
from rumi.tasks.touch_box.scene import TouchTask, draw_truth
from rumi.tasks.touch_box.selection import Choice, Rollouts, choose, expects_contact
from rumi.tasks.touch_box.settings import TouchSettings
from sensors.touch.contact_model import ContactModel

_DRAWS = 4  # rounds of candidates, until enough can be followed
_SUBSTEP_M = 0.0025  # motion of the tool at most, from one contact problem to the next
_BINARY_M = 2e-4  # up to which a step of a likelihood takes tool and object to touch
_TOUCH_M = 5e-4  # distance at which a particle counts as touched


@dataclass(frozen=True, eq=False)
class TouchStep:
    """One poke and what came of it.

    Attributes:
        candidates: (C, K + 1, 3), that were weighed.
        choice: their worth, and the best.
        touched: what was done and felt.
        belief: poses (N, 3) and log-weights (N) after it.
        grasp: the best one then.
        truth: (3,), of the box then; for judging alone.
        seconds: by stage.
    """

    candidates: Float[Tensor, "C K1 3"]
    choice: Choice
    touched: Touched
    belief: tuple[Float[Tensor, "N 3"], Float[Tensor, "N"]]
    grasp: Grasp
    truth: Float[Tensor, "3"]
    seconds: dict[str, float]


@dataclass(frozen=True, eq=False)
class TouchRun:
    """A whole run.

    Attributes:
        first: poses and log-weights before the first poke.
        start: (3,), of the box before it.
        steps: pokes.
        grasp: that was carried out.
        lifted: whether the box was.
        sure: whether the threshold was reached.
        truth: (3,), of the box before the grasp.
        seconds: by stage, in all.
    """

    first: tuple[Float[Tensor, "N 3"], Float[Tensor, "N"]]
    start: Float[Tensor, "3"]
    steps: list[TouchStep]
    grasp: Grasp
    lifted: bool
    sure: bool
    truth: Float[Tensor, "3"]
    seconds: dict[str, float] = field(default_factory=dict)


@runtime_checkable
class Decide(Protocol):
    """Chooses among pokes."""

    def __call__(self, belief: TouchBelief, *, generator: torch.Generator) -> tuple[Float[Tensor, "C K1 3"], Choice]:
        """Candidates and the choice among them."""
        ...


class Toucher:
    """What finds the box: filter, pokes, their choice.

    Args:
        task: what is known of the scene.
        settings: of all of it.
        robot: that pokes; of it the tool's footprint and which paths it can follow are asked.
        table: of grasps' success.
        carrier: how a tool moves boxes; by the settings' push model if None.
    """

    def __init__(
        self,
        task: TouchTask,
        settings: TouchSettings,
        robot: TouchRobot,
        table: GraspTable,
        carrier: Carrier | None = None,
    ) -> None:
        self.task, self.settings, self.robot, self.table = task, settings, robot, table
        self.carrier = carrier or carry
        rates = getattr(robot, "rates", task.rates)
        model = ContactModel(rates[0], rates[1], settings.decay, tolerance=_BINARY_M)
        centre = torch.zeros(2, dtype=torch.float64)
        substeps = max(settings.filter.substeps, math.ceil(task.spacing_m / _SUBSTEP_M - 1e-9))
        own = replace(for_task(settings.filter, task), substeps=substeps)
        if settings.weigh_correlated:
            repeats = getattr(robot, "correlation", task.correlation)
            own = replace(own, temper=own.temper * (1.0 - repeats) / (1.0 + repeats))
        self.filter = TouchFilter(task.outline, centre, robot.pusher, model, task.prior, own, carrier=self.carrier)
        self.hold = max(1, round(settings.poke.hold_m / task.spacing_m))
        self.support = SharedSupport(StateMetric.planar(0.06), settings.poke.neighbours, floor=1e-4)

    def candidates(self, belief: TouchBelief, *, generator: torch.Generator) -> Float[Tensor, "C K1 3"]:
        """Pokes that the robot can follow; some that it cannot where there are too few others."""
        task, own = self.task, self.settings.poke
        found: list[Tensor] = []
        able = 0
        for _ in range(_DRAWS):
            drawn = pokes(
                belief.pose[0],
                belief.log_weights[0],
                task.outline,
                task.half,
                self.robot.pusher,
                own.candidates,
                length_m=task.spacing_m * task.readings,
                readings=task.readings,
                bend=own.bend,
                generator=generator,
            )
            can = self.robot.feasible(drawn)
            found = [drawn[can], *found, drawn[~can]]  # those that it can follow come first
            able += int(can.sum())
            if able >= own.candidates:
                break
        return torch.cat(found)[: own.candidates]

    def rollouts(
        self, belief: TouchBelief, paths: Float[Tensor, "C K1 3"], rows: Tensor
    ) -> tuple[Rollouts, Float[Tensor, "C T N"]]:
        """What candidates do to some particles, and how far the tool then is from each."""
        poses = belief.pose[0, rows]
        count, number = len(paths), len(rows)
        sliding = Sliding(torch.zeros(number, 2, dtype=poses.dtype), belief.lever[0, rows], belief.friction[0, rows])
        own = self.filter.settings
        carried = self.carrier(
            poses.repeat(count, 1),
            paths.repeat_interleave(number, 0),
            self.robot.pusher,
            self.task.outline,
            Sliding(*(part.repeat(count, *[1] * (part.ndim - 1)) for part in sliding)),
            substeps=own.substeps,
            passes=own.passes,
        )
        distance = carried.distance.view(count, number, -1).transpose(1, 2)
        track = carried.track.view(count, number, -1, 3).transpose(1, 2)
        states = torch.cat((poses.expand(count, 1, number, 3), track), 1)
        even = poses.new_zeros(number).log_softmax(-1)
        return Rollouts(states, self.filter.model(distance), distance <= _TOUCH_M, even), distance

    def decide(self, belief: TouchBelief, *, generator: torch.Generator) -> tuple[Float[Tensor, "C K1 3"], Choice]:
        """Weigh candidates over some particles, drawn by weight."""
        own = self.settings.poke
        paths = self.candidates(belief, generator=generator)
        drawn = resample_systematic(belief.log_weights[0], generator=generator)
        rows = drawn[torch.linspace(0, len(drawn) - 1, own.particles).round().long()]
        alone = self.settings.method == "ml-observation"
        if alone:  # rolled out beside the others, whose weights leave it out
            rows = torch.cat((rows, rows.new_tensor([likeliest(belief, self.task.prior, self.support.metric)])))
        rollouts, _ = self.rollouts(belief, paths, rows)
        if alone:
            even = rollouts.log_weights.new_zeros(own.particles).log_softmax(-1)
            rollouts = rollouts._replace(
                log_weights=torch.nn.functional.pad(even, (0, 1), value=-math.inf), likeliest=own.particles
            )
        return paths, choose(
            self.settings.method,
            rollouts,
            self.support,
            hold=self.hold,
            samples=own.samples,
            every=own.every,
            funnel=own.funnel,
            generator=generator,
        )

    def watch(self, belief: TouchBelief, path: Float[Tensor, "K1 3"]) -> Callable[[Touched], bool]:
        """Whether to go on with a poke, asked after each reading: until the belief expects contact to have lasted.

        The particles are rolled along the path once; readings change their weights alone.
        """
        own = self.settings.poke
        rows = torch.arange(belief.pose.shape[1])
        rollouts, distance = self.rollouts(belief, path[None], rows)
        touching = rollouts.touching[0]
        log = [belief.log_weights[0]]

        def go_on(touched: Touched) -> bool:
            done = len(touched.contact)
            if len(log) <= done:  # once for every reading
                signal = touched.contact[-1]
                gained = self.filter.model.log_likelihood(distance[0, done - 1], signal)
                log.append(log[-1] + self.filter.settings.temper * gained)
            return float(expects_contact(touching[:done], log[-1], self.hold)[-1]) <= own.sure

        return go_on

    def grasp(self, belief: TouchBelief) -> Grasp:
        """The best grasp of a belief."""
        return best_grasp(belief.pose[0], belief.log_weights[0], self.table)


def for_task(settings: ReplaySettings, task: TouchTask) -> ReplaySettings:
    """The filter's priors, which settings give for the default task's box, for that of another task.

    The limit surface's range goes by the lever of even pressure; the tool's friction keeps its place relative to the
    task's range.
    """
    usual, (low, high) = TouchTask(), task.friction
    ratio = task.even_lever_m / usual.even_lever_m
    least, most = (ratio * end for end in settings.lever_m)
    friction = settings.friction
    if task.friction != usual.friction:
        begin, end = usual.friction
        share = (high - low) / (end - begin)
        friction = (max(0.0, low + share * (friction[0] - begin)), max(0.0, low + share * (friction[1] - begin)))
    return replace(settings, lever_m=(least, most), friction=friction)


def likeliest(belief: TouchBelief, prior: PlanarPrior, metric: StateMetric) -> int:
    """The particle of one run with the most weight, copies taken together.

    Of those that weigh the same, as all do after a resampling but for copies, the one whose start and readings are
    likeliest.
    """
    weights = merged(belief.pose[0], belief.log_weights[0], metric).log_weights
    # sums of the same weights differ by rounding
    heaviest = weights >= weights.max() - 1e-9
    posterior = belief.log_likelihood[0] + prior.log_density(belief.start[0])
    return int(torch.where(heaviest, posterior, -math.inf).argmax())


def localise(
    toucher: Toucher, *, seed: int, on_step: Callable[[TouchStep], None] | None = None, decide: Decide | None = None
) -> TouchRun:
    """Poke until a grasp is likely enough to succeed, or there have been enough pokes; then grasp.

    Args:
        toucher: how.
        seed: of the truth and of all randomness.
        on_step: called after every poke.
        decide: chooses pokes, such as `rumi.tasks.touch_box.budget.BudgetedChoice`; the toucher itself by default.
    """
    decide = decide or toucher.decide
    settings, robot = toucher.settings, toucher.robot
    clock = Clock()
    random = {name: split(seed, name) for name in ("initial", "filter", "plan")}
    robot.reset(draw_truth(toucher.task, seed), seed)
    start = robot.box_pose()
    belief = toucher.filter.initial(1, settings.count, generator=random["initial"])
    first = (belief.pose[0], belief.log_weights[0])
    history: list[TouchAction] = []
    steps: list[TouchStep] = []
    totals: dict[str, float] = {}
    grasp = toucher.grasp(belief)
    while grasp.probability < settings.threshold and len(steps) < settings.actions:
        with clock("plan"):
            paths, choice = decide(belief, generator=random["plan"])
            path = paths[choice.best, : int(choice.steps[choice.best]) + 1]
        with clock("watch"):
            go_on = toucher.watch(belief, path) if settings.stop_early else _always
        with clock("robot"):
            touched = robot.execute(path, go_on)
        with clock("filter"):
            history.append(TouchAction(touched.path, touched.contact, touched.blocked))
            belief, _ = toucher.filter.step(belief, history, generator=random["filter"])
        with clock("grasp"):
            grasp = toucher.grasp(belief)
        seconds = clock.take()
        for name, value in seconds.items():
            totals[name] = totals.get(name, 0.0) + value
        kept = (belief.pose[0], belief.log_weights[0])
        steps.append(TouchStep(paths, choice, touched, kept, grasp, robot.box_pose(), seconds))
        if on_step is not None:
            on_step(steps[-1])
    truth = robot.box_pose()
    lifted = robot.grasp(grasp.pose)
    return TouchRun(first, start, steps, grasp, lifted, grasp.probability >= settings.threshold, truth, totals)


def _always(touched: Touched) -> bool:
    return True


def signals(contact: Bool[Tensor, "K"]) -> str:
    """Readings as a word of 0 and 1."""
    return "".join("1" if one else "0" for one in contact.tolist())
