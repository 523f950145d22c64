"""Find the mug from Python: a task, a belief that follows the readings, a policy that chooses the actions."""

from pathlib import Path

from rumi import build, preset, run


def main(task: str = "mug-0", seed: int = 0, steps: int = 40, cache: Path | None = None) -> bool:
    """Rummage until sure, print each step, and tell whether the belief is sure of the pose."""
    settings = preset("default", task=task, seed=seed, steps=steps)

    def show(step):
        x, y, _ = step.belief.mode()[:3, 3].tolist()
        print(f"step {step.step}: mug near ({x:.3f}, {y:.3f}) m, expects an nll of {step.expected_nll:.1f}")

    with build(settings, cache_dir=cache or Path.home() / ".cache" / "rumi") as (robot, rummager):
        result = run(robot, rummager, seed=seed, steps=steps, on_step=show)
    print(f"{result.stopped_by} after {result.steps} actions; position error {result.position_error_mm:.1f} mm")
    return result.stopped_by == "sure"


if __name__ == "__main__":
    main()
