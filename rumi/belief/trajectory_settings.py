"""Settings of trajectories of a pushed object: priors of its motion, noise of the sensors, effort of the filter."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Any, Self

from annotated_types import Interval

from sdf.bounds import Checked, Count, CountOr0, Law, NotNegative, Positive, Share, ShareBelow1

# wide enough for what is no mug: a bracket, a bottle, a ball, whose pushes nothing is fitted to
_OTHERS: dict[str, Any] = {
    "friction": (0.5, 0.35),
    "lever_ratio": (1.3, 0.15),
    "ahead": (0.09, 0.11),
    "centre_m": 0.004,
    "centre_change_m": 0.0,
    "friction_change": 0.2,
    "lever_change": 0.1,
    "along": 0.15,
    "across": 0.35,
    "turn_rad_per_m": 3.0,
    "pad_slope_m": 0.0007,
}
# fitted to pushes of drawn, simulated mugs, which stand on the rim of their foot (results/push_models.md)
_MUGS: dict[str, Any] = {
    "lever_ratio": (1.3, 0.08),
    "ahead": (0.45, 0.2),
    "rim": True,
    "centre_change_m": 0.015,
    "along": 0.03,
    "across": 0.027,
    "turn_rad_per_m": 0.6,
}
_NATS = Law("to be 0 or 1e-6 nats at least", lambda nats: not 0 < nats < 1e-6)
_ABOUT = Law("as two finite numbers (x, y)", lambda about: about is None or all(map(math.isfinite, about)))
_PLACE = Law(
    "as three finite numbers (x, y, z)",
    lambda place: place is None or (len(place) == 3 and all(map(math.isfinite, place))),
)


@dataclass(frozen=True)
class PoseTrajectorySettings(Checked):
    """Priors of a pushed object's motion, noise of the sensors, and effort of the filter; metres and radians.

    Friction and lever of a particle are log-normal, and change a little from segment to segment. After each instant
    the pose is off by noise in proportion to the step, the same throughout a segment: the model's errors last. The
    numbers of the pads are fitted to pushes of drawn, simulated mugs (results/push_models.md), those of the motion in
    `for_mugs`; what is left at its default is replaced by those of `for_mugs` or `for_others` in the plane.

    Attributes:
        particles: N, where a view shows the object.
        first_particles: N of the first touch, for which those of the view are drawn anew from start poses that were
            searched all round; 0 for no more than there are.
        unseen_particles: N of the bootstrap filter, where only a prior tells of the object at first; at most.
        fewest_particles: the same at least, once it was touched, by KLD-sampling.
        sampling_error: Kullback-Leibler distance, nats, within which N particles are to stand for a belief that takes
            up so many cells of 5 mm and .1 rad (KLD-sampling). 0: a third of `unseen_particles` where it is narrow.
        islands: populations that share these particles.
        exchanged: share of each population that comes from the others before an action with contact, which then has to
            explain it as well as those it came to. That brings back what one of them lost, and couples what they are
            sure of.
        evidence_power: of each population's evidence, by which it is weighed where nothing is exchanged: 1 as if no
            noise were in it, 0 evenly.
        branches: motions drawn for each particle when a segment comes in.
        instants: of contact that make a segment.
        lag: pushed segments, from the last on, whose noise is still moved by itself.
        memory: segments beyond which the older half is forgotten: the particles then stand for it as they are, and
            neither start poses nor physics move any more.
        replicates: times that the last action is taken in once more, by other draws, where a belief would be sure
            enough to stop; all their particles are pooled, since a few may be sure of what others deny.
        rounds: of Metropolis moves once readings count in full; one at every stage of tempering before.
        tool_spacing_m: between the points of the tool's border that push an upright object: where they are far apart, a
            handle's bar sinks in between two, and is pushed along a wrong normal.
        friction: median and log-deviation of the coefficient between tool and object.
        lever_ratio: median and log-deviation of c of the limit surface over the mean distance of the base from below
            the centre of mass.
        ahead: mean and deviation of how far the pressure's centre is ahead, in the direction of the push, as a share of
            the tool's height above the floor: what is pushed high up tips. The floor's friction, in theory.
        rim: whether it rests on its rim or on corners: less goes ahead where friction at the tool holds its side down,
            and the lever shrinks as the pressure gathers (`rumi.dynamics.sliding.gathered`). None: True of mugs,
            else False.
        push_m: longest part of the tool's way whose contacts are settled at once, metres: beyond the middle of a thin
            handle the nearest way out is its far side. 0 for an instant's whole way.
        centre_m: deviation of the centre of friction from below the centre of mass, along x and along y.
        centre_change_m: deviation of a whole action's own shift of that centre, times how far the size of its noise is
            above 1: now and then the object turns about quite another place, as where a handle is hooked.
        friction_change, lever_change: log-deviation from segment to segment.
        along, across: deviations of a step along itself and across it, as shares of its length.
        turn_rad_per_m: deviation of its turn.
        m_per_rad: length that a radian of a step counts as.
        least_m: length that every instant in which the tool moves an upright object counts as at least, added to its
            step's: contacts set in and let go otherwise than the model's by as much as it takes a small step to go.
        fall_m: length that a fall counts as.
        firm_change: log-deviation of the tilt at which an object falls over.
        lean, slip: parts of the tool's way by which what leans on it, and what it pushes along, may slip in space.
        soft: median, metres, and log-deviation of how far the tool goes into an object, and it into the floor, when
            pressed on from above.
        grip: deviations of the noise along the way beyond which the tool drags along what it presses on from above, and
            the share of its own way, up to 1, for each deviation more.
        unfitted: how much wider the noise of motion is in space than in the plane, where it is fitted. None is 3.5 of
            what is soon toppled, and so touched with care, else 5.
        tails: h of the size of an action's noise, exp(h z^2 / 2) of a standard normal z: once in a while all of it is
            large.
        shared: part of its variance that a whole action has in common.
        seen_sd_m: deviation of what a camera sees.
        seen_points: independent points that all seen surface points of a view are worth.
        seen_again_points: the same of each later view where a camera looks after every action, since its views err
            alike; what it saw through then is worth less in the same measure.
        looks_again: whether a camera looks after every action.
        free_m, free_sd_m, free_weight: depth allowed to a free point, deviation beyond, and what a cell of
            `free_cell_m` is worth; all those that the tool goes through at once no more than `seen_points`.
        free_cell_m: lattice that keeps one free point a cell.
        free_points: independent points that all free ones of a view are worth, at most.
        free_most: points that are kept of them.
        felt_m, felt_sd_m, felt_weight: mean distance of felt points from the surface, its deviation, and what those of
            an instant are worth.
        pad_m, pad_slope_m, pad_weight, pad_spacing_m: distance within which a pad's point feels the surface, width of
            that border, what a point is worth, and the points' spacing.
        fresh_m: way of the tool in an instant from which on its pads' readings count in full, as shares of it below:
            what is felt while something holds the tool up was felt before. 0 counts all in full; None is 3 mm in
            space, else 0.
        force_rad: deviation of the direction of a tool's force from the motion that it makes, where it is measured.
        force_n: deviation of a segment's mean force, N, each way.
        force_per_m: independent readings of its direction that a metre of the tool's way in contact is worth; 0 leaves
            measured forces out.
        moved_m, moved_rad: deviations of place and turn of a segment's motion, where something senses it, beside what
            that is stated to err by: draws of how an object leans and falls come no nearer.
        outliers: share of readings that mean nothing.
        missed: share of a pad's instants in which all of it feels nothing, whatever is there.
        dead: share of the pads' points that never feel.
        false: share of a pad's instants in which it feels what is not there.
        lone: a touch is told as a point, as a wrench tells it, whose height is uncertain, and nothing of what the rest
            of the tool feels meanwhile.
        tool_off_m, tool_off_rad: deviations of where the tool is taken to be in a run, along each axis, and of its yaw.
        worn: mean and deviation of how much deeper the object's surface lies than its model's, in metres.
        size_off: log-deviation of the object's size from its model's, in the plane.
        height_off: deviations of how high the object's origin is above the floor in space, in metres and as a share of
            the model's: of a worn object, and of another size. None: as these are stated.
        view_off_m, view_off_rad: deviations of where a camera has the object in a run, along each axis, and of the turn
            about a vertical axis by which all that it sees is off.
        view_about_m: (x, y) of that axis, metres: of the point that a camera was calibrated by. None for that of a
            task's own camera, or where nobody knows.
        eye_m: (x, y, z) of a camera that is some way off, world frame, metres: what it sees of an upright object is on
            the side of a wall that faces it. None where nobody knows, so that it may be on either. A task's own camera,
            where this is its place, is known by the point that it was calibrated by, too.
        most: points that are kept of a view, of what the tool went through, and of a segment's felt points and pads; of
            a view that is worth less than the first as much less, free ones too.
    """

    particles: Count = 150
    first_particles: CountOr0 = 0
    unseen_particles: Count = 12000
    fewest_particles: Count = 1800
    sampling_error: Annotated[NotNegative, _NATS] = 0.0
    islands: Count = 3
    exchanged: Share = 0.0
    evidence_power: Share = 0.2
    branches: Count = 6
    instants: Count = 5
    lag: Count = 10
    memory: Count = 80
    replicates: CountOr0 = 0
    rounds: Count = 2
    tool_spacing_m: Positive = 0.002
    friction: tuple[Positive, NotNegative] = (0.45, 0.3)
    lever_ratio: tuple[Positive, NotNegative] = (1.25, 0.12)
    ahead: tuple[NotNegative, NotNegative] = (0.25, 0.06)
    rim: bool | None = None
    push_m: NotNegative = 0.004
    centre_m: NotNegative = 0.001
    centre_change_m: NotNegative = 0.025
    friction_change: NotNegative = 0.1
    lever_change: NotNegative = 0.05
    along: NotNegative = 0.05
    across: NotNegative = 0.045
    turn_rad_per_m: NotNegative = 1.0
    m_per_rad: NotNegative = 0.02
    least_m: NotNegative = 0.0
    fall_m: NotNegative = 0.06
    firm_change: NotNegative = 0.2
    lean: NotNegative = 0.4
    slip: NotNegative = 0.1
    soft: tuple[NotNegative, NotNegative] = (0.001, 1.0)
    grip: tuple[NotNegative, NotNegative] = (0.5, 1.5)
    unfitted: Positive | None = None
    tails: NotNegative = 0.5
    shared: Share = 0.5
    seen_sd_m: Positive = 0.0015
    seen_points: NotNegative = 25.0
    seen_again_points: NotNegative = 8.0
    looks_again: bool = False
    free_m: NotNegative = 0.001
    free_sd_m: Positive = 0.0015
    free_weight: NotNegative = 0.15
    free_cell_m: Positive = 0.005
    free_points: NotNegative = 1000.0
    free_most: Count = 1000
    felt_m: NotNegative = 0.0015
    felt_sd_m: Positive = 0.002
    felt_weight: NotNegative = 0.5
    pad_m: NotNegative = 0.003
    pad_slope_m: Positive = 0.0003
    pad_weight: NotNegative = 0.03
    pad_spacing_m: Positive = 0.0025
    fresh_m: NotNegative | None = None
    force_rad: Positive = 0.15
    force_n: NotNegative = 0.2
    force_per_m: NotNegative = 20.0
    moved_m: Positive = 0.003
    moved_rad: Positive = 0.04
    outliers: Annotated[float, Interval(gt=0.0, lt=0.5)] = 0.02
    missed: ShareBelow1 = 0.0
    dead: ShareBelow1 = 0.0
    false: ShareBelow1 = 0.0
    lone: bool = False
    tool_off_m: NotNegative = 0.0
    tool_off_rad: NotNegative = 0.0
    worn: tuple[NotNegative, NotNegative] = (0.0, 0.0)
    size_off: NotNegative = 0.0
    height_off: tuple[NotNegative, NotNegative] | None = None
    view_off_m: NotNegative = 0.0
    view_off_rad: NotNegative = 0.0
    view_about_m: Annotated[tuple[float, float] | None, _ABOUT] = None
    eye_m: Annotated[tuple[float, float, float] | None, _PLACE] = None
    most: tuple[Count, Count, Count, Count] = (500, 250, 60, 120)

    def for_mugs(self) -> Self:
        """The same for mugs: numbers of the motion that are left at their defaults are fitted ones.

        Where `rim` is False all of them are as they are: so settings on record of before have it.
        """
        return self if self.rim is False else self.where_default(_MUGS)

    def for_others(self) -> Self:
        """The same for upright objects other than mugs: numbers that are left at their defaults are wide ones."""
        return self.where_default(_OTHERS)

    def where_default(self, numbers: Mapping[str, Any]) -> Self:
        """The same with other numbers in the place of those that are left at their defaults."""
        usual = type(self)()
        left = {name: own for name, own in numbers.items() if getattr(self, name) == getattr(usual, name)}
        return replace(self, **left)

    @property
    def systematic(self) -> bool:
        """Whether anything is off by the same in a whole run."""
        return any((self.tool_off_m, self.tool_off_rad, *self.worn, self.size_off, self.view_off_m, self.view_off_rad))

    @property
    def later_share(self) -> float:
        """Part of a first view that each later one is worth."""
        return self.seen_again_points / self.seen_points if self.looks_again and self.seen_points else 1.0

    def wider(self, camera_m: float, tool_m: float) -> Self:
        """The same where readings are off by more than their noise, by these standard deviations.

        What a whole run is off by is no noise, but a likelihood of independent readings knows no other width.

        Args:
            camera_m: of where what is seen is taken to be, against the model's surface.
            tool_m: of where the tool and what it feels are.
        """
        return replace(
            self,
            seen_sd_m=math.hypot(self.seen_sd_m, camera_m),
            free_sd_m=math.hypot(self.free_sd_m, max(camera_m, tool_m)),
            felt_sd_m=math.hypot(self.felt_sd_m, tool_m),
            # the border is a logistic function, whose deviation is pi / sqrt(3) of its width
            pad_slope_m=math.hypot(self.pad_slope_m, tool_m * math.sqrt(3.0) / math.pi),
        )

    def seen_again(self) -> Self:
        """The same where a camera looks after every action: it sees what a push did, and its views err alike.

        What a push may have done otherwise than foreseen costs little there, for what is seen takes it back.
        """
        return replace(self.freer(2.0), looks_again=True)

    def freer(self, times: float) -> Self:
        """The same where pushes go otherwise than foreseen by so many times as much."""
        return replace(
            self,
            along=times * self.along,
            across=times * self.across,
            turn_rad_per_m=times * self.turn_rad_per_m,
        )

    def doubted(self) -> Self:
        """The same where pushes go otherwise than any prior has it: rough or slippery, hardly predictable motion."""
        friction, lever, ahead = self.friction, self.lever_ratio, self.ahead
        return replace(
            self.freer(3.0),
            friction=(friction[0], max(0.7, friction[1])),
            lever_ratio=(lever[0], max(0.3, lever[1])),
            ahead=(ahead[0], max(0.11, ahead[1])),
            centre_m=max(0.004, self.centre_m),
            friction_change=max(0.2, self.friction_change),
            lever_change=max(0.1, self.lever_change),
            pad_slope_m=2.0 * self.pad_slope_m,
        )
