"""Figures 3 and 4 of the touch-only paper: seconds by stage, and what three filters keep of a belief."""

import math
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.dynamics.sliding import rotated
from rumi.seeding import split
from rumi.viz import style
from scripts.bench.touch_filters import PushSetup, Variant, make_filter, prior_of, truth_of

_VARIANTS: tuple[Variant, ...] = ("binary", "smooth", "smooth+replay")
_PARTICLES, _SEED = 100, 3


def draw_times(groups: dict[str, list[dict[str, Any]]], path: Path) -> str:
    """Box plots of the seconds of every stage of a poke, of all methods together; and their medians as text.

    Args:
        groups: lines of Table I by method.
        path: of the picture.
    """
    stages: dict[str, list[float]] = {}
    for lines in groups.values():
        for line in lines:
            # the first poke of a process compiles
            for step in line["steps"][1:]:
                for name, value in step["seconds"].items():
                    stages.setdefault(name, []).append(value)
                stages.setdefault("whole poke", []).append(sum(step["seconds"].values()))
    names = sorted(stages, key=lambda name: -sum(stages[name]) / len(stages[name]))
    with style.figure(5.2, 0.4 * len(names) + 0.9) as figure:
        ax = figure.subplots()
        ax.boxplot(
            [stages[name] for name in reversed(names)],
            orientation="horizontal",
            tick_labels=list(reversed(names)),
            showmeans=True,
            meanline=True,
            sym="",
            medianprops={"color": style.INK},
            meanprops={"color": style.CONTACT, "linestyle": "--"},
        )
        ax.set(xlabel="seconds a poke", xscale="log", title="Seconds by stage")
        figure.savefig(path)
    medians = {name: sorted(values)[len(values) // 2] for name, values in stages.items()}
    return "Median seconds a poke: " + ", ".join(f"{name} {medians[name]:.3f}" for name in names)


def draw_filters(path: Path) -> None:
    """One straight push of a box by a round finger: the prior, the truth's way, and what three filters end with."""
    setup = PushSetup()
    truth, actions = truth_of(setup, _SEED + 1, generator=split(0, "figure"))
    own = [action._replace(contact=action.contact[_SEED:]) for action in actions]
    with style.figure(9.5, 2.4) as figure:
        axes = figure.subplots(1, 5)
        prior = make_filter(setup, "smooth").initial(1, _PARTICLES, generator=split(0, "particles"))
        _belief(axes[0], prior.pose[0], prior.log_weights[0], setup, "prior")
        way = torch.stack([action.path[-1, :2] for action in own])
        _belief(axes[1], truth[_SEED][None], torch.zeros(1), setup, "the push; signals in red")
        axes[1].plot(*way.T.tolist(), color=style.PATH, linewidth=1.0)
        felt = torch.stack([action.contact[0, 0] for action in own])
        axes[1].scatter(*way[felt].T.tolist(), s=7, color=style.CONTACT, zorder=5)
        for ax, variant in zip(axes[2:], _VARIANTS, strict=True):
            follow = make_filter(setup, variant)
            belief, random = prior, split(0, variant)
            for t in range(len(own)):
                belief, _ = follow.step(belief, own[: t + 1], generator=random, resample=t < len(own) - 1)
            active = int((belief.log_weights.exp() > 1e-4).sum())
            _belief(ax, belief.pose[0], belief.log_weights[0], setup, f"{variant}: {active} active")
            _outline(ax, truth[_SEED], setup, color=style.TRUTH, linewidth=1.4)
        figure.savefig(path)


def _belief(
    ax: Any,  # noqa: ANN401
    poses: Float[Tensor, "N 3"],
    log_weights: Float[Tensor, "N"],
    setup: PushSetup,
    title: str,
) -> None:
    weights = log_weights.softmax(-1)
    for pose, weight in zip(poses, weights, strict=True):
        # many of one weight are drawn faintly, few heavy ones strongly
        strength = min(0.9, 0.05 + 1.6 * math.sqrt(float(weight))) if len(poses) > 1 else 1.0
        color = style.EXPECTED if len(poses) > 1 else style.TRUTH
        if float(weight) > 1e-4:
            _outline(ax, pose, setup, color=color, linewidth=0.6, alpha=strength)
    reach = 3.0 * max(prior_of(setup).spread[:2].tolist()) + max(setup.half)
    ax.set(xlim=(-reach, reach + setup.length_m * 0.5), ylim=(-reach, reach), xticks=[], yticks=[])
    ax.set_aspect("equal")
    ax.set_title(title, fontsize=8)
    for spine in ax.spines.values():
        spine.set_visible(False)


def _outline(ax: Any, pose: Float[Tensor, "3"], setup: PushSetup, **kind: Any) -> None:  # noqa: ANN401
    signs = torch.tensor([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0], [1.0, 1.0]], dtype=pose.dtype)
    corners = pose[:2] + rotated(signs * pose.new_tensor(setup.half), pose[2])
    ax.plot(*corners.T.tolist(), **kind)
