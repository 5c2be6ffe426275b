"""Many files on a cluster: what one process makes, whatever dies on the way. The cluster is this machine, two cores."""

import contextlib
import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import fisheyerec as fr
from fisheyerec import bulk
from fisheyerec.file_rectifiers import CalibratedRectifier, FileReport, ViewOptions
from fisheyerec.folders import Companion, Task
from fisheyerec.pictures import Picture, write_picture
from fisheyerec.replacement import replacement

cluster = pytest.importorskip("fisheyerec.cluster", reason="clusters need fisheyerec[ray]")

if not sys.platform.startswith("linux"):
    pytest.skip("finds processes as Linux shows them", allow_module_level=True)

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning:ray")

SIZE = (48, 64)
CAMERA = fr.FisheyeCamera.from_projection("equidistant", 120, SIZE)
RECTIFIER = CalibratedRectifier(CAMERA, ViewOptions(), threads=1)
PYTHONPATH = os.pathsep.join(filter(None, [str(Path(fr.__file__).parents[1]), os.environ.get("PYTHONPATH")]))

cluster.ray.cloudpickle.register_pickle_by_value(sys.modules[__name__])  # workers do not find the tests


@pytest.fixture(scope="module")
def two_workers():
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", PYTHONPATH)
        with cluster.connected("local", 2):
            yield


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def tree(here):
    """in/: JPEG with EXIF, 16 bit PNG, pictures in a folder below, and one that is none."""
    rng = np.random.default_rng(0)
    Path("in/b").mkdir(parents=True)
    write_picture("in/deep.png", Picture(rng.integers(0, 65536, (*SIZE, 3), dtype=np.uint16)))
    for number in range(70):  # enough for batches of several
        write_picture(f"in/b/{number}.png", Picture(rng.integers(0, 256, (*SIZE, 3), dtype=np.uint8)))
    Image.fromarray(rng.integers(0, 9, SIZE, dtype=np.uint8)).save("labels.png")
    exif = Image.Exif()
    exif[0x0110] = "a camera"
    Image.fromarray(rng.integers(0, 256, (*SIZE, 3), dtype=np.uint8)).save("in/exif.jpg", exif=exif)
    Path("in/broken.png").write_text("none")
    CAMERA.save("lens.json")


def tasks_into(folder):
    sources = [path for path in sorted(Path("in").rglob("*")) if path.is_file()]
    tasks = [Task(source, folder / source.relative_to("in")) for source in sources]
    labels = Companion("labels", Path("labels.png"), folder / "labels.png")
    tasks = [task._replace(companions=(labels,)) if task.source.name == "0.png" else task for task in tasks]
    for task in tasks:
        task.target.parent.mkdir(parents=True, exist_ok=True)
    return tasks


def contents(folder):
    return {path.relative_to(folder): path.read_bytes() for path in Path(folder).rglob("*") if path.is_file()}


def told(outcomes):
    """What was said of each file, but for the time it took."""
    return {
        task.source: (
            error,
            report and (report.summary, report.camera.params.tolist(), report.view.params.tolist()),
        )
        for task, _, report, error in outcomes
    }


# --- Outcomes -------------------------------------------------------------------------------------


def test_files_and_reports_are_those_of_one_process(two_workers, tree):
    expected = told(bulk.run(tasks_into(Path("bulk")), RECTIFIER))
    outcomes = list(cluster.run(tasks_into(Path("cluster")), RECTIFIER))
    assert told(outcomes) == expected
    assert [task.source.name for task, *_, error in outcomes if error is not None] == ["broken.png"]
    assert len(outcomes) == 73
    assert contents("cluster") == contents("bulk")
    assert Path("labels.png") in contents("cluster")
    assert Image.open("cluster/exif.jpg").getexif()[0x0110] == "a camera"


class Deadly:
    """A rectifier in the middle of which workers end: of the file "always" each, of "once" the first, from outside."""

    def __call__(self, task, *, on_frame):
        source = task.source
        with replacement(task.target) as temporary:
            temporary.write_text("half")
            if source.name == "always":
                os.kill(os.getpid(), signal.SIGKILL)
            if source.name == "once" and not Path("pid").exists():
                Path("noted").write_text(str(os.getpid()))
                os.rename("noted", "pid")
                time.sleep(300)
            temporary.write_text(source.name)
        return FileReport(CAMERA, CAMERA, "")


def test_killed_workers_lose_nothing_and_the_file_that_kills_them_all_fails(two_workers, here, capfd):
    def kill():
        while not Path("pid").exists():
            time.sleep(0.01)
        os.kill(int(Path("pid").read_text()), signal.SIGKILL)

    Path("out").mkdir()
    tasks = [Task(Path(name), Path("out", name)) for name in ("1", "once", "2", "always", "3", "4")]
    with ThreadPoolExecutor(1) as pool:
        killed = pool.submit(kill)
        errors = {outcome.task: outcome.error for outcome in cluster.run(tasks, Deadly())}
    killed.result()
    assert errors == {task: "always: 3 workers died of it" if task.source.name == "always" else None for task in tasks}
    assert contents("out") == {Path(name): name.encode() for name in ("1", "once", "2", "3", "4")}
    assert capfd.readouterr() == ("", "")


class Endless:
    """A rectifier of a video that comes to no end."""

    def __call__(self, task, *, on_frame):
        source = task.source
        with replacement(task.target) as temporary:
            temporary.write_text("half")
            Path(f"{source.stem}.begun").touch()
            while source.name != "0.mp4":
                on_frame(0, None)
                time.sleep(0.01)
        return FileReport(CAMERA, CAMERA, "")


def test_a_run_that_is_given_up_breaks_off_videos_and_begins_nothing_new(two_workers, here):
    Path("out").mkdir()
    outcomes = cluster.run([Task(Path(f"{n}.mp4"), Path(f"out/{n}.mp4")) for n in range(20)], Endless())
    assert next(outcomes).task.source.name == "0.mp4"
    outcomes.close()
    assert len(list(here.glob("*.begun"))) <= 3
    assert os.listdir("out") == ["0.mp4"]


def test_ctrl_c_stays_one_whatever_ray_says_as_it_is_closed(two_workers, here, monkeypatch):
    whole = cluster.ray.data.Dataset.iter_batches

    def untidy(*args, **kwargs):
        try:
            yield from whole(*args, **kwargs)
        finally:
            raise RuntimeError("untidy")

    monkeypatch.setattr(cluster.ray.data.Dataset, "iter_batches", untidy)
    Path("out").mkdir()
    outcomes = cluster.run([Task(Path(f"{n}.mp4"), Path(f"out/{n}.mp4")) for n in range(3)], Endless())
    next(outcomes)
    with pytest.raises(KeyboardInterrupt):
        outcomes.throw(KeyboardInterrupt)


# --- Clusters that will not do --------------------------------------------------------------------


def test_another_version_on_a_machine_is_refused(two_workers, here, monkeypatch):
    monkeypatch.setattr(cluster, "__version__", "99.0")
    with pytest.raises(ConnectionError, match=rf"expected fisheyerec 99\.0 on [\d.]+ .*, got {fr.__version__}$"):
        next(cluster.run([Task(Path("a.png"), Path("b.png"))], RECTIFIER))


def test_a_folder_that_workers_do_not_see_is_refused(two_workers, here):
    descriptor = os.open(here, os.O_RDONLY)
    mine = Path(f"/proc/self/fd/{descriptor}")  # of each process another file
    with pytest.raises(ConnectionError, match=rf"a folder that [\d.]+ of the Ray cluster sees too, got {mine}$"):
        next(cluster.run([Task(Path("a.png"), mine / "b.png")], RECTIFIER))
    os.close(descriptor)
    assert os.listdir() == []


# --- The command line -----------------------------------------------------------------------------


def command(*arguments):
    return [sys.executable, "-P", "-m", "fisheyerec.cli", "rectify", *map(str, arguments)]


def run(*arguments):
    return subprocess.run(
        command(*arguments),
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
        env={**os.environ, "PYTHONPATH": PYTHONPATH},
    )


def closed_port():
    with socket.socket() as stream:
        stream.bind(("127.0.0.1", 0))
        return stream.getsockname()[1]


@pytest.mark.parametrize("address", ["nonsense", "ray://127.0.0.1:10001", f"127.0.0.1:{closed_port()}"])
def test_a_cluster_that_is_not_there_is_one_line(tree, address):
    result = run("in", "-o", "out", "--camera", "lens.json", "--cluster", address)
    assert (result.returncode, len(result.stderr.splitlines())) == (2, 1), result.stderr
    assert re.search(rf"fisheyerec rectify: expected a Ray cluster .*{re.escape(address)}", result.stderr)
    assert contents("out") == {}


def test_ray_is_asked_for_where_it_is_missing(run_python, tree, here):
    arguments = ["rectify", f"{here}/in", "-o", f"{here}/out", "--camera", f"{here}/lens.json", "--cluster", "local"]
    lines = "import sys; sys.modules['ray'] = None; from fisheyerec.cli import app; app(sys.argv[1:])"
    result = run_python(f"import sys; sys.argv = ['', *{arguments}]\n{lines}")
    assert result.returncode == 2
    assert result.stderr == "fisheyerec rectify: ModuleNotFoundError: Ray is missing: pip install 'fisheyerec[ray]'\n"


def end_session(leader):
    """Kill what is left of the session of a process; Ray's agents take a minute to see that they are alone."""
    found = subprocess.run(["ps", "-o", "pid=", "-s", str(leader)], capture_output=True, text=True, check=False).stdout
    for pid in found.split():
        with contextlib.suppress(ProcessLookupError):
            os.kill(int(pid), signal.SIGKILL)


def test_what_a_dead_driver_leaves_is_whole_and_one_process_does_the_rest(tree, hears_ctrl_c):
    large = Picture(np.random.default_rng(0).integers(0, 256, (960, 1280, 3), dtype=np.uint8))
    write_picture("in/b/0.png", large)
    for number in range(1, 60):
        os.unlink(f"in/b/{number}.png")
        os.symlink("0.png", f"in/b/{number}.png")
    arguments = ("in", "-o", "out", "--camera", "lens.json", "--resume")
    for number, code in ((signal.SIGINT, 130), (signal.SIGKILL, -signal.SIGKILL)):
        process = subprocess.Popen(
            command(*arguments, "--cluster", "local", "--jobs", 2),
            stderr=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": PYTHONPATH},
            start_new_session=True,
            preexec_fn=hears_ctrl_c,
        )
        for _ in range(4):
            assert "valid" in process.stdout.readline()
        process.send_signal(number)
        rest, said = process.communicate(timeout=300)
        assert process.returncode == code, f"{said}\nafter {rest.count('valid') + 4} pictures"
        if number == signal.SIGINT:
            *others, last = said.splitlines()
            assert re.fullmatch(r"fisheyerec rectify: interrupted after \d+ of 73 files", last)
            assert all("broken.png" in line for line in others)
            assert not list(Path("out").rglob("*.part*"))
        end_session(process.pid)
    result = run(*arguments)
    assert result.returncode == 1
    assert result.stderr.splitlines()[-1].endswith("1 of {} files failed".format(result.stdout.count("valid") + 1))
    assert run("in", "-o", "bulk", "--camera", "lens.json").returncode == 1
    found, expected = contents("out"), contents("bulk")
    written = [entries(each.pop(Path("manifest.jsonl"))) for each in (found, expected)]
    assert found == expected
    assert written[0] == written[1]


def entries(manifest):
    """The last line about each output, but for the time it took."""
    lines = map(json.loads, manifest.splitlines())
    return {line["output"]: {key: value for key, value in line.items() if key != "seconds"} for line in lines}
