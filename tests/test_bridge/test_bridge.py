"""The bridge, from a client that talks nonsense to the example's robot."""

import json
import os
import random
import socket
import subprocess
import sys
from dataclasses import replace

import pytest
import torch

pytest.importorskip("msgspec")

from rumi import rummager
from rumi.bridge.messages import Sample, decoder
from rumi.bridge.served import ClientGoneError, thinned
from rumi.bridge.server import Served, listen
from rumi.cli import main
from rumi.commands.serve import ServeOptions, made
from rumi.fields.workspace import Workspace
from rumi.runs.export import estimates_of
from rumi.runs.folder import load_run
from rumi.tasks.registry import entry_of
from rumi.tasks.rummage.settings import preset
from tests.fixtures.bridge import BOUNDS, SCRIPTS, TOOL, WITHIN, Waver, serving
from tests.test_scripts.test_own_robot import code_lines


class Client:
    def __init__(self, port):
        self.socket = socket.create_connection(("127.0.0.1", port), timeout=60)
        self.lines = self.socket.makefile("rb")

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.lines.close()
        self.socket.close()

    def raw(self, data):
        self.socket.sendall(data)

    def tell(self, **message):
        self.raw(json.dumps(message).encode() + b"\n")

    def hear(self):
        return json.loads(self.lines.readline())

    def until(self, kind):
        while (told := self.hear())["type"] != kind:
            pass
        return told


def whole_run(port):
    """A client that does all as it should."""
    with Client(port) as client:
        assert client.hear()["control"] == ["x", "y", "yaw"]
        client.tell(type="start", tool=TOOL)
        for step in range(2):
            assert client.until("belief")["step"] == step
            action = client.until("action")
            assert action["control"] == [0, 1, 0] and len(action["path"]) == 20
            assert action["path"][-1][1] == pytest.approx(0.08 * (step + 1), abs=1e-6)
            for pose in action["path"]:
                client.tell(type="sample", tool=pose)
            client.tell(type="done", stamp=step + 1)
        assert client.until("end")["stopped_by"] == "sure"


def test_a_run_by_messages():
    with serving(Served(Waver(), WITHIN), 1) as port:
        whole_run(port)


REFUSED = [
    ({"type": "dance"}, "Invalid value 'dance'"),
    ({"tool": TOOL}, "missing required field `type`"),
    ({"type": "done"}, "Expected start now, got done"),
    ({"type": "start", "tool": TOOL[:3]}, "length 7 - at `$.tool`"),
    ({"type": "start", "tool": TOOL, "colour": 1}, "unknown field `colour`"),
    ({"type": "start", "tool": [1e5, *TOOL[1:]]}, "`float` <= 1000.0"),
    ({"type": "start", "tool": TOOL, "schema": 9}, "Expected schema 1, got 9"),
    ({"type": "start", "tool": [0] * 7}, "unit quaternion"),
]


def test_a_message_that_is_none_is_refused_by_name():
    with serving(Served(Waver(), WITHIN), 1) as port, Client(port) as client:
        client.hear()
        for message, words in REFUSED:
            client.tell(**message)
            assert words in client.until("error")["message"]
        for raw in (b"\xff\xfe\n", b"NaN\n", b"[" * 5000 + b"\n", b'{"type":"start","tool":[NaN]}\n'):
            client.raw(raw)
            assert client.hear()["type"] == "error"
        client.tell(type="start", tool=TOOL)
        client.until("action")
        client.tell(type="done")
        assert "a sample before done" in client.hear()["message"]
        client.tell(type="sample", tool=[0, 0, 0, 0, 0, 0, 2])
        assert "unit quaternion" in client.hear()["message"]
        client.tell(type="stop")
        assert client.until("end")["stopped_by"] == "interrupted"


def test_clients_that_die_or_talk_nonsense_harm_nobody():
    noise = random.Random(0)
    good = [b'{"type":"start","tool":[0.25,0,0.06,0,0,0,1]}\n', b'{"type":"sample","tool":[0.3,0,0.06,0,0,0,1]}\n',
            b'{"type":"done"}\n', b'{"type":"stop"}\n']  # fmt: skip

    def nonsense():
        lines = bytearray(b"".join(noise.choices(good, k=noise.randrange(1, 8))))
        for _ in range(noise.randrange(0, 6)):
            at = noise.randrange(len(lines))
            lines[at : at + noise.randrange(0, 9)] = noise.randbytes(noise.randrange(0, 9))
        return bytes(lines)

    with serving(Served(Waver(), WITHIN, patience_s=5.0), 41) as port:
        for _ in range(40):
            with Client(port) as client:
                client.raw(nonsense())
                if noise.random() < 0.5:
                    client.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")  # a reset
        whole_run(port)


def test_a_client_that_says_nothing_is_left():
    with serving(Served(Waver(), WITHIN, patience_s=0.05), 2) as port, Client(port) as client:
        client.hear()
        assert client.lines.readline() == b"", "the server has hung up"
        with Client(port) as other:
            assert other.hear()["type"] == "hello"


def test_thousands_of_samples_become_a_reading_that_keeps_what_touched():
    samples = [Sample(tuple(TOOL), touched=((0.1, 0.2, 0.3),) if k == 777 else False) for k in range(1000)]
    kept = thinned(samples)
    assert len(kept) == 20 and kept[-1] is samples[-1] and samples[777] in kept
    assert [id(one) for one in thinned(samples[:3])] == [id(one) for one in samples[:3]]
    assert thinned(samples[:1]) == samples[:1]


def test_a_line_without_an_end_ends_the_connection(monkeypatch):
    monkeypatch.setattr("rumi.bridge.served.LINE", 100)
    with serving(Served(Waver(), WITHIN), 1) as port, Client(port) as client:
        client.hear()
        client.raw(b"x" * 200)
        told = client.hear()
        assert told["fatal"] and "less than 100 bytes" in told["message"]


def small_agent():
    settings = preset("fast", steps=2)
    few = replace(settings.initialise, particles=12, starts=40, polished=12)
    mppi = replace(settings.planner.mppi, samples=8)
    settings = replace(settings, initialise=few, planner=replace(settings.planner, mppi=mppi, rollouts=1))
    workspace = Workspace.from_bounds(BOUNDS, 0.01, planar_height=0.06)
    from sdf.object_model import box_model

    return rummager(box_model(), workspace, motion="measured", settings=settings)


def test_the_example_client_pushes_a_box_and_leaves_a_run(tmp_path):
    source = (SCRIPTS / "bridge_client.py").read_text()
    assert len(code_lines(source, imports=True)) <= 40 and "import rumi" not in source
    with serving(Served(small_agent(), WITHIN, tmp_path), 1) as port:
        done = subprocess.run(
            [sys.executable, "-I", str(SCRIPTS / "bridge_client.py"), str(port)],
            capture_output=True, text=True, timeout=120, check=True,
        )  # fmt: skip
    run = load_run(tmp_path / "run")
    assert len(run.steps) == 3 and run.result.stopped_by == "steps"
    *steps, end = done.stdout.splitlines()
    assert [line.split()[0] for line in steps] == ["0", "1", "2"] and "'type': 'end'" in end
    last = [float(word) for word in steps[-1].split()[2:]]
    assert last == pytest.approx(run.steps[-1].belief.mode()[:3, 3].tolist(), abs=1e-6), "the pose that came over"


def test_the_belief_that_comes_over_is_the_one_that_is_kept(tmp_path):
    """Pose and covariance to the last digit that JSON has, as those of the run's folder."""
    seen = [[0.52, 0.01 * y, 0.01 * z] for y in range(-7, 8) for z in range(21)]
    heard = []
    with serving(Served(small_agent(), WITHIN, tmp_path), 1) as port, Client(port) as client:
        client.tell(type="start", tool=TOOL, surface=seen)
        for _ in range(3):
            heard.append(client.until("belief")["pose"])
            if len(heard) < 3:
                for pose in client.until("action")["path"]:
                    client.tell(type="sample", tool=pose, motion=[0, 0, 0, 0, 0, 0, 1])
                client.tell(type="done")
        client.until("end")
    run = load_run(tmp_path / "run")
    kept = estimates_of(run, entry_of(run).pose).steps
    for told, one in zip(heard, kept, strict=True):
        assert torch.tensor(told["world_T_object"]).double() == pytest.approx(one.pose.world_T_object, abs=1e-6)
        assert told["covariance"] == one.pose.as_dict()["covariance"]


def test_a_view_without_the_object_ends_the_run_and_nothing_else(tmp_path):
    with serving(Served(small_agent(), WITHIN, tmp_path), 1) as port, Client(port) as client:
        client.hear()
        client.tell(type="start", tool=TOOL)
        told = client.hear()
        assert told["fatal"] and "Expected a first view with surface points" in told["message"]
        assert list(tmp_path.iterdir()) == []
        client.tell(type="done")
        assert "Expected start now" in client.hear()["message"]


@pytest.mark.slow
def test_readings_that_make_no_sense_end_at_most_their_run():
    """Messages that are well formed and that no robot sends, to the real agent; then one that a robot sends."""
    noise = random.Random(1)
    seen = [[0.52, 0.01 * y, 0.01 * z] for y in range(-7, 8) for z in range(21)]
    still, far = [0, 0, 0, 0, 0, 0, 1], [900.0, -900.0, 900.0, 0.6, 0.0, 0.8, 0.0]
    with serving(Served(small_agent(), WITHIN), 1) as port, Client(port) as client:
        client.hear()
        for view, tool, touched, motion in (
            (seen, far, True, far),
            (seen[:1], TOOL, [[1000.0, 1000.0, -1000.0]], still),
            ([[noise.uniform(-1000, 1000) for _ in range(3)] for _ in range(50)], TOOL, seen, far),
            (seen, TOOL, False, still),
        ):
            client.tell(type="start", tool=tool, surface=view)
            told = client.hear()
            while told["type"] != "end" and not told.get("fatal"):
                if told["type"] == "action":
                    for _ in range(2):
                        client.tell(type="sample", tool=tool, touched=touched, motion=motion)
                    client.tell(type="done")
                told = client.hear()
        assert told["type"] == "end"


def test_a_bug_ends_the_run_and_not_the_server(capsys, monkeypatch):
    def broken(self, state):
        raise IndexError("a bug")

    with serving(Served(Waver(), WITHIN), 1) as port, Client(port) as client:
        client.hear()
        with monkeypatch.context() as patched:
            patched.setattr(Waver, "act", broken)
            client.tell(type="start", tool=TOOL)
            told = client.until("error")
            assert told["fatal"] and told["message"] == "the run broke off: IndexError: a bug"
        client.tell(type="start", tool=TOOL)
        client.until("action")
    assert "Traceback" in capsys.readouterr().err


@pytest.mark.slow
def test_a_server_that_is_killed_leaves_a_readable_run(tmp_path):
    command = [sys.executable, "-m", "rumi", "serve", "--builtin", "box", "--motion", "measured", "--port", "0"]
    command += [
        "--workspace",
        *["0.2", "-0.3", "0.06", "0.85", "0.3", "0.06"],
        "--preset",
        "fast",
        "--out",
        str(tmp_path),
    ]
    env = {**os.environ, "PYTHONPATH": str(SCRIPTS.parent)}
    server = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=env)
    try:
        port = int(server.stderr.readline().split("port ")[1].split(";")[0])
        with Client(port) as client:
            client.hear()
            seen = [[0.52, 0.01 * y, 0.01 * z] for y in range(-7, 8) for z in range(21)]
            client.tell(type="start", tool=TOOL, surface=seen)
            assert client.until("belief")["step"] == 0
            for pose in client.until("action")["path"]:
                client.tell(type="sample", tool=pose, motion=[0, 0, 0, 0, 0, 0, 1])
            client.tell(type="done")
            assert client.until("belief")["step"] == 1
            server.kill()
    finally:
        server.kill()
        server.wait()
    run = load_run(tmp_path / "run")
    assert len(run.steps) == 2 and run.ended is None


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--workspace", *["0", "0", "0", "1", "1", "0"]], "Expected the object, by --mesh FILE or by --builtin NAME"),
        (["--workspace", *["1", "0", "0", "0", "1", "0"], "--builtin", "box"], "a lower and an upper corner"),
        (["--workspace", *["0", "0", "0.1", "1", "1", "0.1"], "--builtin", "can"], "There is no object 'can'"),
        (["--builtin", "box"], "--workspace"),
        (
            ["--workspace", *["0", "0", "0", "1", "1", "0"], "--builtin", "box", "--motion", "auto"],
            "got auto: leave it out where nothing measures the motion",
        ),
    ],
)
def test_bad_input_is_named(arguments, message, capsys, tmp_path):
    assert main(["serve", *arguments, "--out", str(tmp_path / "runs")]) == 2
    assert message in capsys.readouterr().err


def test_a_port_that_is_taken_is_named():
    from rumi.errors import UsageError

    with listen("127.0.0.1", 0) as listener, pytest.raises(UsageError, match="give another --port"):
        listen("127.0.0.1", listener.getsockname()[1])


def test_options_make_an_agent_in_the_plane():
    served = made(ServeOptions(workspace=((0.2, -0.3, 0.06), (0.85, 0.3, 0.06)), builtin="box", prior_mean=(0.5, 0.0)))
    assert served.agent.filter.settings.motion == "corrected" and served.agent.steps == 40
    assert served.within.tolist()[1][2] == pytest.approx(0.3)
    assert decoder.decode(b'{"type":"stop"}') and ClientGoneError
