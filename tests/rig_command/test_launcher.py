"""The launcher: children that die, hang or lose their parent leave a clear word and nothing else."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import textwrap
from pathlib import Path

import pytest

from common.bus import BusSettings, open_bus, router
from common.config import ConfigError
from rig import launcher
from rig.launcher import LaunchError, launch
from rig.statuses import Statuses
from tests.waiting import until

ROOT = Path(launcher.__file__).parent.parent


@pytest.fixture
def services(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Make a service's module out of a few lines; the launcher finds it under the service's name."""
    folder = tmp_path / "modules"
    folder.mkdir()
    monkeypatch.setenv("PYTHONPATH", f"{folder}{os.pathsep}{ROOT}")

    def make(name: str, lines: str) -> str:
        (folder / f"fake_{name}.py").write_text(textwrap.dedent(lines))
        monkeypatch.setitem(launcher.MODULES, name, f"fake_{name}")
        return name

    return make


def gone(pid: int) -> bool:
    """Whether there is no such process, or only its shell."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] == "Z"
    except OSError:
        return True


def test_a_service_that_ends_is_named_with_the_end_of_its_log(services):
    name = services("predictor", "import sys; print('the last words'); sys.exit(7)")
    with launch({}, [name]) as crew:
        crew.children[0].process.wait(10)
        with pytest.raises(LaunchError, match=r"predictor ended with code 7[\s\S]*the last words"):
            crew.check()


def test_a_service_killed_from_outside_is_named_with_the_signal(services):
    name = services("riskfield", "import signal; signal.pause()")
    with launch({}, [name]) as crew:
        crew.check()
        crew.children[0].process.kill()
        crew.children[0].process.wait(10)
        with pytest.raises(LaunchError, match="riskfield was killed by signal 9"):
            crew.check()


def test_a_service_that_refuses_its_configuration_is_bad_input(services):
    name = services("planner", "import sys; print('planner: [planner] no such key', file=sys.stderr); sys.exit(2)")
    with launch({}, [name]) as crew:
        crew.children[0].process.wait(10)
        with pytest.raises(ConfigError, match="no such key"):
            crew.check()


def test_a_service_that_is_never_up_is_named_with_what_it_said_last(services):
    name = services(
        "planner", "print('still thinking', flush=True)\nimport signal; signal.pause()"
    )  # fmt: skip
    with router() as endpoint, open_bus(BusSettings(connect=(endpoint,)), "ego", "rig") as bus:
        statuses = Statuses(bus, [name])
        with launch({}, [name]) as crew:
            until(lambda: "thinking" in crew.children[0].tail())
            with pytest.raises(LaunchError) as error:
                crew.wait_ready(statuses, 0.3)
    assert "planner: has said nothing yet" in str(error.value)
    assert "still thinking" in str(error.value)


def test_a_service_deaf_to_sigterm_is_killed_at_the_deadline(services, monkeypatch):
    monkeypatch.setattr(launcher, "STOP_S", 0.3)
    name = services(
        "predictor",
        "import signal; signal.signal(signal.SIGTERM, signal.SIG_IGN); print('deaf', flush=True)\n"
        "while True: signal.pause()",
    )
    with launch({}, [name]) as crew:
        child = crew.children[0]
        until(lambda: "deaf" in child.tail())
    assert child.process.returncode == -signal.SIGKILL


def test_children_stop_when_the_body_fails(services):
    name = services("predictor", "import signal; signal.pause()")
    with pytest.raises(ZeroDivisionError), launch({}, [name]) as crew:
        raise ZeroDivisionError
    assert crew.children[0].process.returncode is not None


def test_a_child_gets_exactly_the_given_configuration_and_one_thread(services, monkeypatch):
    monkeypatch.setenv("FOREFIELD__PLANNER__MAX_SPEED", "99")
    name = services(
        "planner",
        "import os, json; from common import config\n"
        "print(json.dumps([config.load(), os.environ['OMP_NUM_THREADS'], os.environ['PYTHONSAFEPATH']]))",
    )
    with launch({"vehicle": "van", "planner": {"max_speed": 3.0}}, [name]) as crew:
        crew.children[0].process.wait(20)
        assert crew.children[0].tail() == '[{"vehicle": "van", "planner": {"max_speed": 3.0}}, "1", "1"]'


def test_a_run_leaves_no_file_behind_not_even_while_it_lasts(services, tmp_path, monkeypatch):
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    name = services("predictor", "print('up', flush=True); import signal; signal.pause()")
    with launch({"vehicle": "van"}, [name]) as crew:
        until(lambda: "up" in crew.children[0].tail())
        assert not list(folder.iterdir())


def test_logs_are_kept_where_asked(services, tmp_path):
    name = services("predictor", "print('kept')")
    with launch({}, [name], logs=tmp_path / "logs") as crew:
        crew.children[0].process.wait(10)
    assert (tmp_path / "logs" / "predictor.log").read_text() == "kept\n"


def test_a_launcher_killed_by_sigkill_leaves_no_orphans(services, tmp_path):
    first = services("predictor", "import signal; signal.signal(signal.SIGTERM, signal.SIG_IGN); signal.pause()")
    second = services("riskfield", "while True: pass")
    script = (
        "from rig import launcher\n"
        f"launcher.MODULES.update({{'{first}': 'fake_{first}', '{second}': 'fake_{second}'}})\n"
        f"with launcher.launch({{}}, ['{first}', '{second}']) as crew:\n"
        "    print(*[c.process.pid for c in crew.children], flush=True)\n"
        "    input()\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", script], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=tmp_path
    ) as parent:
        assert parent.stdout is not None
        pids = [int(p) for p in parent.stdout.readline().split()]
        commands = [Path(f"/proc/{p}/cmdline") for p in pids]
        assert len(pids) == 2
        until(lambda: all(b"fake_" in c.read_bytes() and b"rig.child" not in c.read_bytes() for c in commands))
        parent.kill()
        parent.wait()
        until(lambda: all(gone(p) for p in pids))
