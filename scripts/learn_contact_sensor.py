"""Parameters of a contact sensor learnt through the filter, with standard errors and a profile.

    python -m scripts.learn_contact_sensor                      # 200 episodes, seeds 1000 to 1002: lines and a figure
    python -m scripts.learn_contact_sensor --episodes 50 --seeds 1000 2 --out learnt

Episodes are touches of a mug by a probe, signals of a known sensor; its poses are unknown to the learner
(`scripts/train_through_filter.py`). Errors are of the curvature of the log evidence at the optimum, by differences of
its gradient with the same draws; the profile of a parameter has the others trained again at each of its values.
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import tyro
from torch import Tensor

from rumi.cli import script
from scripts.train_through_filter import log_evidence, record, train
from sensors.touch.contact_model import ContactModel

NAMES = ("true_positive", "false_positive", "decay")
TRUE, START = (0.85, 0.08, 120.0), (0.5, 0.3, 40.0)


@dataclass(frozen=True)
class Options:
    """Learn a contact sensor from recorded episodes.

    Attributes:
        episodes: of each set; as many are held out.
        touches: of an episode.
        particles: of the filter.
        steps: of the optimiser.
        seeds: first seed and number of sets.
        out: folder of contact_sensor.jsonl and contact_sensor.png.
    """

    episodes: int = 200
    touches: int = 24
    particles: int = 200
    steps: int = 60
    seeds: tuple[int, int] = (1000, 3)
    out: Path = Path("scripts/results")


def raw(sensor: ContactModel) -> Tensor:
    """What is trained: logits of the rates and the logarithm of the decay (3)."""
    return torch.stack([getattr(sensor, f"raw_{name}").detach() for name in NAMES])


def put(sensor: ContactModel, values: Tensor) -> None:
    """Set what is trained."""
    with torch.no_grad():
        for name, value in zip(NAMES, values, strict=True):
            getattr(sensor, f"raw_{name}").copy_(value)


def physical(sensor: ContactModel) -> list[float]:
    """The sensor's three numbers."""
    return [float(getattr(sensor, name).detach()) for name in NAMES]


def gradient(sensor: ContactModel, at: Tensor, data: Sequence[Tensor], particles: int, draws: int) -> Tensor:
    """Gradient (3) of the summed negative log evidence at raw values, the mean over some draws of the filter."""
    put(sensor, at)
    total = torch.zeros(3)
    parameters = [getattr(sensor, f"raw_{name}") for name in NAMES]
    for seed in range(draws):
        loss = -log_evidence(sensor, *data, particles, torch.Generator().manual_seed(10_000 + seed)).sum()
        total += torch.stack(torch.autograd.grad(loss, parameters)) / draws
    return total


def standard_errors(sensor: ContactModel, data: Sequence[Tensor], particles: int, draws: int = 4) -> list[float]:
    """Of the three physical numbers, by the inverse curvature (observed information) and the delta method."""
    at, step = raw(sensor), 0.2
    rows = []
    for axis in range(3):
        shift = step * torch.eye(3)[axis]
        ahead = gradient(sensor, at + shift, data, particles, draws)
        rows.append((ahead - gradient(sensor, at - shift, data, particles, draws)) / (2.0 * step))
    put(sensor, at)
    curvature = torch.stack(rows)
    covariance = torch.linalg.inv(0.5 * (curvature + curvature.mT))
    rate, false, decay = physical(sensor)
    slope = torch.tensor([rate * (1.0 - rate), false * (1.0 - false), decay])
    return (slope * covariance.diagonal().clamp_min(0.0).sqrt()).tolist()


def held_out(sensor: ContactModel, data: Sequence[Tensor]) -> float:
    """Mean negative log evidence of an episode, by 1000 particles."""
    with torch.no_grad():
        return -float(log_evidence(sensor, *data, 1000, torch.Generator().manual_seed(9)).mean())


def learn(options: Options, seed: int) -> dict[str, Any]:
    """Record, train and judge one set."""
    random, true = torch.Generator().manual_seed(seed), ContactModel(*TRUE)
    data, held = (record(true, options.episodes, options.touches, random) for _ in range(2))
    sensor = ContactModel(*START, trainable=True)
    train(sensor, *data, particles=options.particles, steps=options.steps, seed=1000 * seed)
    errors = standard_errors(sensor, data, options.particles)
    found = physical(sensor)
    return {
        "found": dict(zip(NAMES, found, strict=True)),
        "standard_errors": dict(zip(NAMES, errors, strict=True)),
        "within": {
            name: abs(one - truth) <= max(0.1 * truth, 2.0 * error)
            for name, one, truth, error in zip(NAMES, found, TRUE, errors, strict=True)
        },
        "held_out": {
            "learnt": held_out(sensor, held),
            "true": held_out(true, held),
            "start": held_out(ContactModel(*START), held),
        },
    }


def profile(options: Options, seed: int, factors: Sequence[float]) -> list[float]:
    """Negative log evidence, less the least, at multiples of the true decay, the rates trained again at each."""
    data = record(ContactModel(*TRUE), options.episodes, options.touches, torch.Generator().manual_seed(seed))
    found = []
    for factor in factors:
        sensor = ContactModel(0.8, 0.1, factor * TRUE[2], trainable=True)
        sensor.raw_decay.requires_grad_(False)
        train(sensor, *data, particles=options.particles, steps=max(1, options.steps // 6), seed=1000 * seed)
        with torch.no_grad():
            draws = (torch.Generator().manual_seed(10_000 + k) for k in range(3))
            found.append(sum(-float(log_evidence(sensor, *data, options.particles, one).sum()) / 3 for one in draws))
    return [value - min(found) for value in found]


def draw(lines: Sequence[dict[str, Any]], factors: Sequence[float], profiled: Sequence[float], file: Path) -> None:
    """Estimates with two standard errors beside the truth, and the profile of the decay."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, 4, figsize=(9, 2.4), layout="constrained")
    titles = ("hit rate", "false alarms", "fall-off, 1/m")
    for axis, name, truth, title in zip(axes, NAMES, TRUE, titles, strict=False):
        axis.errorbar(
            [line["seed"] for line in lines],
            [line["found"][name] for line in lines],
            [2.0 * line["standard_errors"][name] for line in lines],
            fmt="o",
            capsize=3,
            color="tab:blue",
        )
        axis.axhline(truth, color="black", linewidth=1)
        axis.set(title=title, xlabel="set", xticks=[line["seed"] for line in lines])
    axes[3].plot([factor * TRUE[2] for factor in factors], profiled, "o-", color="tab:blue")
    axes[3].axvline(TRUE[2], color="black", linewidth=1)
    axes[3].axhline(2.0, color="grey", linewidth=1, linestyle="--")  # two standard errors of a parabola
    axes[3].set(title="profile", xlabel="fall-off, 1/m", ylabel="nats below the best")
    figure.savefig(file, dpi=150)
    pyplot.close(figure)


def main(options: Options) -> list[dict[str, Any]]:
    """Learn from each set, its line added to the file as it comes, and draw; what is there is not done again."""
    torch.set_num_threads(1)
    options.out.mkdir(parents=True, exist_ok=True)
    file = options.out / "contact_sensor.jsonl"
    first, count = options.seeds
    asked = {name: getattr(options, name) for name in ("episodes", "touches", "particles", "steps")}

    def once(about: dict[str, Any], work: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        lines = file.read_text(encoding="utf-8").splitlines() if file.is_file() else []
        for line in map(json.loads, lines):
            if about.items() <= line.items():
                return dict(line)
        line = about | work()
        with file.open("a", encoding="utf-8") as out:
            out.write(json.dumps(line) + "\n")
        print(json.dumps(line), flush=True)
        return line

    lines = [once({"seed": seed} | asked, lambda: learn(options, seed)) for seed in range(first, first + count)]  # noqa: B023
    factors = (0.7, 0.85, 1.0, 1.2, 1.5)
    profiled = once({"profile": first} | asked, lambda: {"nats": profile(options, first, factors)})["nats"]
    draw(lines, factors, profiled, options.out / "contact_sensor.png")
    return lines


if __name__ == "__main__":
    script(lambda: main(tyro.cli(Options)))
