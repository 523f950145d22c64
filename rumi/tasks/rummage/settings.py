"""All settings of a run as one value: presets, and the way to JSON and back."""

import math
import types
import typing
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Annotated, Any, Literal, TypeVar, get_args, get_origin

import torch
import tyro

from rumi.belief.initialise import InitialiseSettings
from rumi.belief.pose_filter import FilterSettings
from rumi.belief.reinitialise import RenewalSettings
from rumi.errors import UsageError
from rumi.information.stop_rule import StopSettings
from rumi.planning.gpvr import GPVRSettings
from rumi.planning.registry import PolicySettings
from rumi.planning.rummaging import RummagingSettings
from rumi.registration.descent import DescentSettings
from rumi.sim.settings import SimSettings
from rumi.tasks.rummage.objects import ObjectSettings

Preset = Literal["default", "fast", "paper"]

_T = TypeVar("_T")


@dataclass(frozen=True)
class Settings(PolicySettings):
    """Everything that decides a run, beside the `PolicySettings`.

    The same settings on the same machine give the same run.

    Attributes:
        task: what to find; `rumi tasks` lists them.
        preset: where all other settings started from; "paper" holds the paper's Table IV.
        seed: of all randomness.
        steps: actions at most; None for as many as the task allows.
        device: "cpu" or "cuda".
        dtype: of the belief and the planner.
        replan_every: actions carried out of one plan; a contact always asks for a new one.
        budget_s: seconds that each plan may take, for which it makes do with less; runs are not the same then from one
            time to the next. None for as long as it needs.
        filter: how the belief follows the readings.
        initialise: how the first belief is found.
        renewal: when and how particles are drawn anew, where no camera sees the object.
        stop: when the belief is sure enough.
        simulator: how the simulator steps and what its sensors report.
        object: the object to find, where that is not the task's own.
    """

    task: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="TASK", help_behavior_hint="(required)")] = "mug-0"
    preset: Preset = "default"
    seed: int = 0
    steps: int | None = None
    device: Literal["cpu", "cuda"] = "cpu"
    dtype: Literal["float32", "float64"] = "float32"
    replan_every: int = 1
    budget_s: Annotated[float | None, tyro.conf.arg(name="budget", metavar="SECONDS")] = None
    filter: FilterSettings = field(default_factory=FilterSettings)
    initialise: InitialiseSettings = field(default_factory=InitialiseSettings)
    renewal: RenewalSettings = field(default_factory=RenewalSettings)
    stop: StopSettings = field(default_factory=StopSettings)
    simulator: SimSettings = field(default_factory=SimSettings)
    object: Annotated[ObjectSettings, tyro.conf.arg(name="")] = field(default_factory=ObjectSettings)

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, valid in (("preset", tuple(PRESETS)), ("device", ("cpu", "cuda"))):
            if getattr(self, name) not in valid:
                raise UsageError(f"There is no {name} {getattr(self, name)!r}; there are {', '.join(valid)}")
        if self.seed < 0:
            raise UsageError(f"Expected seed to be 0 or more, got {self.seed}")
        if self.steps is not None and self.steps < 0:
            raise UsageError(f"Expected steps to be 0 or more, got {self.steps}")
        if self.replan_every < 1:
            raise UsageError(f"Expected replan_every to be 1 or more, got {self.replan_every}")
        if self.budget_s is not None and self.budget_s < 0:
            raise UsageError(f"Expected budget to be 0 or more seconds, got {self.budget_s}")
        for name in _not_numbers(self):
            raise UsageError(f"Expected {name} to be a number, got nan")

    @property
    def torch_device(self) -> torch.device:
        """The device.

        Raises:
            UsageError: there is no such device here.
        """
        if self.device == "cuda" and not torch.cuda.is_available():
            raise UsageError("There is no CUDA device that this PyTorch can use: leave out --device cuda")
        return torch.device(self.device)

    @property
    def torch_dtype(self) -> torch.dtype:
        """The floating dtype."""
        return torch.float32 if self.dtype == "float32" else torch.float64


def preset(name: str = "default", **changes: Any) -> Settings:  # noqa: ANN401  (values of the settings)
    """The settings of a preset.

    Args:
        name: of the preset.
        changes: settings to give another value, such as `task` and `seed`.

    Raises:
        UsageError: there is no such preset; the message lists them.
    """
    if name not in PRESETS:
        raise UsageError(f"There is no preset {name!r}; the presets are {', '.join(PRESETS)}")
    return replace(PRESETS[name](), **changes)


def to_dict(settings: Settings) -> dict[str, Any]:
    """Plain values, ready for JSON; infinity becomes None."""
    from rumi.runs.plain import plain

    return dict(plain(settings))


def from_dict(values: Mapping[str, Any]) -> Settings:
    """Settings from `to_dict`'s values, such as a run folder's `settings.json`; what is missing has its default.

    Raises:
        UsageError: a name that is no setting (the message lists the valid ones), or a value that is none.
    """
    extra = {"schema", "made_with"}
    return _build(Settings, {name: value for name, value in values.items() if name not in extra}, "")


def dataclass_of(kind: type[_T], values: Mapping[str, Any], at: str = "") -> _T:
    """A dataclass from plain values, nested as its fields are; what is missing has its default.

    Args:
        kind: the dataclass.
        values: by field.
        at: what to name before a field in messages.

    Raises:
        UsageError: a name that is no field (the message lists the valid ones), or a value that is none.
    """
    return _build(kind, values, at)


def setting_names(kind: type = Settings, prefix: str = "") -> list[str]:
    """Names of all settings as flags, nested ones with dots."""
    names: list[str] = []
    for name, hint in typing.get_type_hints(kind, include_extras=True).items():
        # a flag may go by another name than the setting, and a group by none
        given = [extra.name for extra in get_args(hint)[1:] if getattr(extra, "name", None) is not None]
        called, inner = given[0] if given else name, get_args(hint)[0] if get_origin(hint) is Annotated else hint
        if is_dataclass(inner) and isinstance(inner, type):
            names += setting_names(inner, f"{prefix}{called}." if called else prefix)
        else:
            names.append(prefix + called)
    return names


def _not_numbers(settings: Any, prefix: str = "") -> Iterator[str]:  # noqa: ANN401  (any settings class)
    """Names of the settings that are NaN, nested ones with dots."""
    for part in fields(settings):
        value, name = getattr(settings, part.name), prefix + part.name
        if is_dataclass(value):
            yield from _not_numbers(value, f"{name}.")
        elif isinstance(value, float) and math.isnan(value):
            yield name


def _default() -> Settings:
    return Settings()


def _fast() -> Settings:
    """A quarter of the starts, a third of the polished poses and a quarter of the rollouts that `default` has.

    What that gives up, `scripts/docs/choosing.md` says with figures.
    """
    planner = RummagingSettings()
    return Settings(
        preset="fast",
        initialise=InitialiseSettings(starts=500, polished=100),
        planner=replace(planner, mppi=replace(planner.mppi, samples=200), rollouts=3),
    )


def _paper() -> Settings:
    """Table IV and the text around it, also where the default has reasons to differ.

    Not the paper's rule to stop, which holds at the first view of a mug: its runs are counted over all actions.
    """
    return Settings(
        preset="paper",
        replan_every=3,
        filter=FilterSettings(
            peakiness=2.0,
            free_scale=10.0,
            tolerance_m=0.0,
            free_spacing_m=0.010,
            surface_spacing_m=0.002,
            translation_noise_m=0.010,
            rotation_noise_rad=0.0,
            unmeasured="estimated",
            trigger=5.0,
            trigger_percentile=1.0,
            weigh_before_resampling=False,
            lies_flat=False,
            descent=DescentSettings(method="adam", iterations=10),
        ),
        renewal=RenewalSettings.never(),
        planner=RummagingSettings.paper(),
        gpvr=GPVRSettings(tolerance=0.0),
        stop=StopSettings(rule="never", apc_ratio=0.03),
        simulator=SimSettings(free_fraction=0.95, free_spacing_m=0.010),
    )


PRESETS: dict[str, Callable[[], Settings]] = {"default": _default, "fast": _fast, "paper": _paper}
"""Settings by preset: `paper` holds the paper's numbers, `default` the best that were found, `fast` cheaper ones."""


def _build(kind: type[_T], values: Any, at: str) -> _T:  # noqa: ANN401  (read from JSON)
    if not isinstance(values, Mapping):
        raise UsageError(f"Expected {at or 'settings'} to be an object with named values, got {values!r}")
    hints = typing.get_type_hints(kind)
    wrong = sorted(set(values) - {f.name for f in fields(kind)})  # type: ignore[arg-type]
    if wrong:
        known = ", ".join(at + name for name in hints)
        raise UsageError(f"There is no setting {at}{wrong[0]}; there are {known}")
    try:
        return kind(**{name: _value(hints[name], value, f"{at}{name}") for name, value in values.items()})
    except UsageError:
        raise
    except (ValueError, TypeError) as error:
        raise UsageError(f"{at.rstrip('.') or 'settings'}: {error}") from error


def _value(hint: Any, value: Any, at: str) -> Any:  # noqa: ANN401  (read from JSON, of the hint's type)
    if is_dataclass(hint) and isinstance(hint, type):
        return _build(hint, value, f"{at}.")
    if get_origin(hint) in (types.UnionType, typing.Union):
        options = get_args(hint)
        if value is None and types.NoneType in options:
            return None
        for option in options:
            try:
                return _value(option, value, at)
            except UsageError:
                continue
        raise UsageError(f"Expected {at} to be {hint}, got {value!r}")
    if get_origin(hint) is Literal:
        if value not in get_args(hint):
            raise UsageError(f"Expected {at} to be one of {', '.join(map(str, get_args(hint)))}, got {value!r}")
        return value
    if get_origin(hint) is tuple and isinstance(value, list | tuple):
        inner = get_args(hint)
        each = inner[:1] * len(value) if inner[1:] == (...,) else inner
        if len(each) != len(value):
            raise UsageError(f"Expected {at} to have {len(each)} values, got {value!r}")
        return tuple(_value(one, item, at) for one, item in zip(each, value, strict=True))
    if hint is float:
        if value is None:
            return math.inf  # what JSON has no word for
        if isinstance(value, int | float) and not isinstance(value, bool):
            return float(value)
    if isinstance(hint, type) and isinstance(value, hint) and isinstance(value, bool) == (hint is bool):
        return value
    name = getattr(hint, "__name__", str(hint))
    raise UsageError(f"Expected {at} to be of type {name}, got {value!r}")
