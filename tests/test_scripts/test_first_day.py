"""The objects of a first day: what they measure, what is refused, and how the table counts."""

from types import SimpleNamespace

import pytest

pytest.importorskip("trimesh")
pytest.importorskip("mujoco")

from scripts import first_day

pytestmark = pytest.mark.sim

SIZES = {  # length, width and height in the file's unit
    "L-bracket in mm": (80, 40, 60),
    "bottle with handle": (0.134, 0.084, 0.22),
    "bottle with holes": (0.134, 0.084, 0.22),
    "spray bottle": (0.1005, 0.052, 0.25),
    "hammer, lying": (296, 100, 32),
    "hammer, standing": (296, 100, 32),
    "can": (0.07, 0.07, 0.12),
    "ball": (0.08, 0.08, 0.08),
    "plate 2 mm": (0.16, 0.1, 0.002),
    "spoon": (0.18, 0.04, 0.006),
    "nut": (0.028, 0.012, 0.02),
    "box 0.6 m": (0.6, 0.3, 0.4),
    "sheet 0.8 mm": (0.0008, 0.1, 0.1),
    "thin post": (0.024, 0.024, 0.18),
    "drill": (0.174, 0.058, 0.187),
    "bracket of 50 kg": (80, 40, 60),
}


def test_their_meshes_are_what_they_are_called():
    assert SIZES.keys() == first_day.OBJECTS.keys()
    for name, size in SIZES.items():
        assert first_day.OBJECTS[name].make().extents.tolist() == pytest.approx(size, rel=0.02), name


@pytest.mark.parametrize(("name", "said"), [("plate 2 mm", "`rumi localize`"), ("box 0.6 m", "at most 400 mm wide")])
def test_what_cannot_be_run_is_refused_with_a_remedy(name, said, cache, monkeypatch):
    monkeypatch.setenv("RUMI_CACHE", str(cache))
    figures = first_day.measure(name, "measured", 1000)
    assert figures["outcome"] == "refused" and said in figures["said"] and "millimetres" not in figures["said"]


@pytest.mark.parametrize(
    ("stopped_by", "mm", "deg", "outcome"),
    [
        ("sure", 4.9, 9.9, "found"),
        ("sure", 5.1, 0.0, "wrong"),
        ("sure", 0.0, 10.1, "wrong"),
        ("steps", 0.0, 0.0, "unsure"),
    ],
)
def test_how_a_run_ends(stopped_by, mm, deg, outcome):
    agent = SimpleNamespace(position_tolerance_m=0.005, rotation_tolerance_rad=0.17453)
    result = SimpleNamespace(stopped_by=stopped_by, position_error_mm=mm, rotation_error_deg=deg)
    assert first_day.outcome(agent, result) == outcome


def test_the_table():
    run = {
        "object": "can",
        "motion": "measured",
        "outcome": "found",
        "steps": 6,
        "said": "",
        "warnings": [],
        "remarks": [],
    }
    lines = [
        run | {"seed": 0, "outcome": "crash"},  # by earlier code
        run | {"seed": 0},
        run | {"seed": 1, "steps": 9, "remarks": ["toppled"]},
        run | {"motion": "corrected", "outcome": "wrong", "warnings": ["not measured"]},
        run | {"seed": 2, "motion": "corrected", "outcome": "wrong", "tips_at": None, "fell_at": 3},
        run | {"seed": 1, "motion": "corrected", "tips_at": 4, "fell_at": None},
        {"object": "spoon", "motion": "measured", "outcome": "refused", "said": "too low"},
    ]
    text = first_day.show(lines, {})
    assert "| can | 2 found | 1 found, 2 wrong | 6 to 9 | 1 of 2 | 0 of 1, 1 of 1 | toppled 1 |" in text
    assert "| spoon | 1 refused | - | - | - | - | - |" in text
    assert "| all | 2 found, 1 refused | 1 found, 2 wrong | 6 to 9 | 1 of 2 | 0 of 1, 1 of 1 | toppled 1 |" in text
    assert "- spoon, refused: too low" in text
