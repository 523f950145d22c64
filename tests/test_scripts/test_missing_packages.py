import subprocess
import sys

import pytest

_WITHOUT = """
import sys
import pytest
sys.modules.update(dict.fromkeys({packages!r}))
sys.exit(pytest.main(["--collect-only", "-q", "-p", "no:cacheprovider", {folder!r}, "tests/test_seeding.py"]))
"""


@pytest.mark.parametrize(
    ("folder", "packages"),
    [
        ("tests/test_rosbag", ["rosbags", "h5py"]),
        ("tests/test_sim", ["mujoco"]),
        ("tests/test_tasks/handle", ["mujoco", "cv2"]),
    ],
)
def test_tests_of_a_missing_package_are_left_out_and_the_others_run(folder, packages):
    program = _WITHOUT.format(packages=packages, folder=folder)
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "test_seeding.py" in done.stdout and folder not in done.stdout
