from __future__ import annotations

import logging
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from rerun.chunk import RrdReader
from rrd import rrd_columns, rrd_entities
from test_recording import (
    BLOB,
    annex_b_packets,
    blob,
    decode_samples,
    encode_clip,
    picture,
    source,
    step_of,
)

import streamtrack.recording.repair as repair
import streamtrack.recording.series as rotation
from streamtrack.errors import OutputError, UsageError
from streamtrack.recording.recorder import Recorder
from streamtrack.recording.repair import is_whole, mend
from streamtrack.recording.series import FileSeries, Hold, Limit, parse_limit
from streamtrack.settings import build_settings


@pytest.mark.parametrize(
    ("text", "limit"),
    [
        ("100MB", Limit(100_000_000)),
        ("1.5 GB", Limit(1_500_000_000)),
        ("64MiB", Limit(1 << 26)),
        ("10min", Limit(None, 600.0)),
        ("7d", Limit(None, 7 * 86400.0)),
        ("2GB, 12h", Limit(2_000_000_000, 43200.0)),
        ("30s,5mb", Limit(5_000_000, 30.0)),
        ("100MB|10min", Limit(100_000_000, 600.0)),
    ],
)
def test_limits(text, limit):
    assert parse_limit(text, "keep") == limit


@pytest.mark.parametrize(
    "text",
    [
        "",
        "100",
        "MB",
        "-1MB",
        "10m",
        "5 parsec",
        "0MB",
        "0s",
        "1GB,2GB",
        "1h,",
        "|1h",
        "1GB|2GB",
        "1e3MB",
        "nanMB",
    ],
)
def test_nonsense_limits_are_refused(text):
    with pytest.raises(UsageError, match="keep"):
        parse_limit(text, "keep")


@pytest.mark.parametrize(
    "values",
    [
        {"rotate": "fast"},
        {"rotate": "1KB"},
        {"rotate": "0.1s"},
        {"keep": "1GB"},
        {"rotate": "100MB", "keep": "150MB"},
        {"rotate": "100MB", "keep": "all"},
    ],
)
def test_settings_refuse_what_cannot_be_held_to(values):
    with pytest.raises(UsageError, match=r"rotate|keep"):
        build_settings({"recording": values})


def make_files(folder, names, size=1000, age_s=0.0):
    for place, name in enumerate(names):
        (folder / name).write_bytes(bytes(size))
        moment = time.time() - age_s - (len(names) - place)
        os.utime(folder / name, (moment, moment))


def test_names_go_on_and_sort_by_time(tmp_path):
    series = FileSeries(tmp_path / "new" / "cam.rrd")
    first, second = series.next_path(), series.next_path()
    assert [first.name, second.name] == ["cam-000001.rrd", "cam-000002.rrd"]
    first.unlink()
    make_files(tmp_path / "new", ["cam-000041.rrd", "cam-9999999.rrd", "other-000050.rrd"])
    assert series.next_path().name == "cam-000042.rrd"
    assert [path.name[4:10] for path in series.paths()] == ["000002", "000041", "000042"]


def test_oldest_own_files_go_and_no_others(tmp_path):
    own = [f"cam-00000{number}.rrd" for number in range(1, 6)]
    foreign = ["cam.rrd", "cam-000001.mp4", "xcam-000001.rrd", "cam-20261125-101010.rrd", "notes"]
    make_files(tmp_path, own + foreign)
    (tmp_path / "cam-000000.rrd").mkdir()
    (tmp_path / "cam-000009.rrd").symlink_to(tmp_path / "notes")
    before = {path.name for path in tmp_path.iterdir()}
    removed = FileSeries(tmp_path / "cam.rrd").remove_beyond(Limit(2500))
    assert [path.name for path, _ in removed] == own[:3]
    assert all("keep" in reason for _, reason in removed)
    assert before - {path.name for path in tmp_path.iterdir()} == set(own[:3])


def test_files_beyond_the_age_go(tmp_path):
    make_files(tmp_path, ["cam-000001.rrd", "cam-000002.rrd"], age_s=3600.0)
    make_files(tmp_path, ["cam-000003.rrd"])
    removed = FileSeries(tmp_path / "cam.rrd").remove_beyond(Limit(None, 60.0))
    assert [path.name for path, _ in removed] == ["cam-000001.rrd", "cam-000002.rrd"]
    assert "1 h old" in removed[0][1]


def test_files_in_use_stay_and_count(tmp_path):
    make_files(tmp_path, ["cam-000001.rrd", "cam-000002.rrd", "cam-000003.rrd"])
    series = FileSeries(tmp_path / "cam.rrd")
    hold = Hold(tmp_path / "cam-000001.rrd")
    with pytest.raises(OutputError, match="another process"):
        Hold(tmp_path / "cam-000001.rrd")
    removed = series.remove_beyond(Limit(6500), reserve_bytes=5000)
    assert [path.name for path, _ in removed] == ["cam-000002.rrd"]
    hold.release()
    removed = series.remove_beyond(Limit(10), reserve_bytes=5000)
    assert [path.name for path, _ in removed] == ["cam-000001.rrd", "cam-000003.rrd"]


def rotating(**values):
    return build_settings({"recording": {"video": "jpeg", **values}})


def files_of(folder):
    return sorted(folder.glob("*.rrd"))


RNG = np.random.default_rng(1)


def noise():
    """A picture that no compression makes small."""
    return RNG.integers(0, 255, (120, 160, 3), np.uint8)


def test_every_file_is_complete_by_itself(tmp_path):
    names = ["board", "door"]
    settings = rotating(rotate="1s")
    with Recorder(tmp_path / "cam.rrd", source(), settings, names) as recorder:
        for index in range(60):
            recorder.log(step_of(index, names, lost=range(20, 35)))
        last = recorder.path
    paths = files_of(tmp_path)
    assert [path.name for path in paths] == [f"cam-00000{number}.rrd" for number in (1, 2, 3)]
    assert paths[-1] == last
    frames = []
    for path in paths:
        assert is_whole(path)
        reader = RrdReader(path)
        assert len(reader.blueprints()) == 1
        entities = rrd_entities(path)
        assert {"/camera/keypoints", "/targets/door/template", "/summary"} <= set(entities)
        assert rrd_columns(path, "/__properties/run", "detector", None)[1] == [["harris"]]
        frames.append(rrd_columns(path, "/camera/image", BLOB)[0])
        assert frames[-1] == rrd_columns(path, "/metrics/ms/flow", "Scalars:scalars")[0]
    assert frames == [list(range(25)), list(range(25, 50)), list(range(50, 60))]
    states = [rrd_columns(path, "/targets/board/state", "StateChange:state") for path in paths]
    assert states == [
        ([0, 20], [["tracking"], ["lost"]]),
        ([25, 35], [["lost"], ["tracking"]]),
        ([50], [["tracking"]]),
    ]
    templates = {
        blob(rrd_columns(path, "/targets/board/template", BLOB, None)[1][0]) for path in paths
    }
    assert len(templates) == 1
    assert (
        len({store.recording_id for path in paths for store in RrdReader(path).recordings()}) == 1
    )


def test_files_keep_to_the_size(tmp_path):
    settings = build_settings({"recording": {"video": "jpeg", "rotate": "1MB", "jpeg_quality": 95}})
    with Recorder(tmp_path / "cam.rrd", source(), settings, []) as recorder:
        for index in range(120):
            recorder.log(step_of(index, (), image=noise()))
            time.sleep(0.005)
    sizes = [path.stat().st_size for path in files_of(tmp_path)]
    assert len(sizes) >= 3
    assert all(700_000 < size < 1_800_000 for size in sizes[:-1])


def test_copied_packets_begin_with_a_keyframe(tmp_path):
    packets = annex_b_packets(encode_clip(70))
    info = source(packet_codec="h264")
    settings = build_settings({"recording": {"rotate": "1s"}})
    with Recorder(tmp_path / "cam.rrd", info, settings, []) as recorder:
        for index in range(0, 69, 3):
            recorder.log(step_of(index + 2, (), packets[index : index + 3]))
    paths = files_of(tmp_path)
    assert len(paths) == 3
    copied, shown = [], []
    for path in paths:
        frames, samples = rrd_columns(path, "/camera/image", "VideoStream:sample")
        keys = rrd_columns(path, "/camera/image", "VideoStream:is_keyframe")[1]
        assert keys[0] == [True]
        pictures = decode_samples("h264", samples)
        assert len(pictures) == len(samples)
        assert np.abs(pictures[-1].astype(int) - picture(frames[-1])).mean() < 8
        copied += [blob(sample) for sample in samples]
        shown += frames
    assert shown == list(range(69))
    assert copied == [packet.data for packet in packets[:69]]


def test_a_stream_without_keyframes_is_cut_late(tmp_path):
    packets = [packet for packet in annex_b_packets(encode_clip(80)) if not packet.is_keyframe]
    settings = build_settings({"recording": {"rotate": "1s"}})
    with Recorder(tmp_path / "cam.rrd", source(packet_codec="h264"), settings, []) as recorder:
        for index, packet in enumerate(packets):
            recorder.log(step_of(index, (), [packet], time_s=packet.time_s))
    assert len(files_of(tmp_path)) == 2


def test_av1_begins_anew_in_each_file(tmp_path):
    settings = rotating(rotate="1s", video="av1")
    with Recorder(tmp_path / "cam.rrd", source(), settings, []) as recorder:
        for index in range(40):
            recorder.log(step_of(index, ()))
    shown = []
    for path in files_of(tmp_path):
        frames, samples = rrd_columns(path, "/camera/image", "VideoStream:sample")
        assert len(decode_samples("libdav1d", samples)) == len(frames)
        shown.append(frames)
    assert shown == [list(range(25)), list(range(25, 40))]


def test_no_file_is_embedded_in_each_part(tmp_path):
    clip = tmp_path / "clip.mp4"
    clip.write_bytes(encode_clip(5, has_b_frames=True))
    settings = build_settings({"recording": {"rotate": "1s"}})
    with Recorder(tmp_path / "cam.rrd", source(asset_path=clip), settings, []) as recorder:
        recorder.log(step_of(0, ()))
    (path,) = files_of(tmp_path)
    assert len(rrd_columns(path, "/camera/image", BLOB)[1]) == 1


def test_what_is_not_to_be_kept_goes_with_the_reason(tmp_path, caplog):
    make_files(tmp_path, ["cam-000001.rrd", "cam.rrd"], size=1_500_000)
    settings = build_settings(
        {"recording": {"video": "jpeg", "rotate": "1MB", "keep": "2MB", "jpeg_quality": 95}}
    )
    with Recorder(tmp_path / "cam.rrd", source(), settings, []) as recorder:
        assert recorder.path.name == "cam-000002.rrd"
        for index in range(100):
            recorder.log(step_of(index, (), image=noise()))
            time.sleep(0.005)
        deadline = time.monotonic() + 10
        while (tmp_path / "cam-000002.rrd").exists() and time.monotonic() < deadline:
            time.sleep(0.05)
    names = [path.name for path in files_of(tmp_path)]
    assert "cam.rrd" in names
    assert "cam-000001.rrd" not in names
    assert "cam-000002.rrd" not in names
    assert recorder.path.name in names
    assert "MB to keep" in caplog.text
    lines = [line for (line,) in rrd_columns(recorder.path, "/log", "TextLog:text")[1]]
    assert any("removed" in line and "MB to keep" in line for line in lines)


def test_a_full_disk_is_a_gap_between_files(tmp_path, monkeypatch, caplog):
    free = {"blocks": 1 << 20}
    monkeypatch.setattr(
        os, "statvfs", lambda _: SimpleNamespace(f_bavail=free["blocks"], f_frsize=4096)
    )
    now = {"s": 0.0}
    monkeypatch.setattr("streamtrack.recording.recorder.time.monotonic", lambda: now["s"])
    settings = rotating(rotate="1h")
    with Recorder(tmp_path / "cam.rrd", source(), settings, ["board"]) as recorder:
        recorder.log(step_of(0))
        free["blocks"] = 10
        recorder.log(step_of(1))
        assert recorder.failed == "the disk is full"
        now["s"] = 61.0
        recorder.log(step_of(2))
        assert recorder.failed == "the disk is full"
        free["blocks"] = 1 << 20
        recorder.log(step_of(3))
        assert recorder.failed is not None  # tried once a minute
        now["s"] = 122.0
        recorder.log(step_of(4))
        assert recorder.failed is None
        recorder.log(step_of(5))
    paths = files_of(tmp_path)
    assert [rrd_columns(path, "/camera/image", BLOB)[0] for path in paths] == [[0], [4, 5]]
    assert caplog.text.count("the disk is full") == 1
    assert caplog.text.count("recording goes on") == 1


def test_an_unwritable_folder_ends_the_recording_at_the_next_file(tmp_path, monkeypatch, caplog):
    settings = rotating(rotate="1s")
    with Recorder(tmp_path / "cam.rrd", source(), settings, []) as recorder:
        recorder.log(step_of(0, ()))

        def refuse(_):
            raise OutputError("cannot write cam: permission denied")

        monkeypatch.setattr(FileSeries, "next_path", refuse)
        recorder.log(step_of(30, ()))
        assert "permission denied" in (recorder.failed or "")
    assert caplog.text.count("permission denied") == 1
    assert is_whole(tmp_path / "cam-000001.rrd")


KILLED_RUN = """
import sys, time
from pathlib import Path
from test_recording import Recorder, source, step_of
from streamtrack.settings import build_settings
settings = build_settings({"recording": {"video": "jpeg", "rotate": "1h"}})
with Recorder(Path(sys.argv[1]), source(), settings, ["board"]) as recorder:
    for index in range(1000):
        recorder.log(step_of(index))
        print(index, flush=True)
        time.sleep(1 / 50)
"""


@pytest.fixture(scope="module")
def killed(tmp_path_factory):
    """What a run leaves that was killed after frame 40."""
    folder = tmp_path_factory.mktemp("killed")
    tests = Path(__file__).parent
    with subprocess.Popen(
        [sys.executable, "-c", KILLED_RUN, str(folder / "cam.rrd")],
        stdout=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(tests), str(tests.parent)])},
        text=True,
    ) as process:
        assert process.stdout is not None
        for line in process.stdout:
            if int(line) == 40:
                process.send_signal(signal.SIGKILL)
    return (folder / "cam-000001.rrd").read_bytes()


LARGE_RUN = """
import os, sys, time
from pathlib import Path
import numpy as np
from dataclasses import replace
from test_recording import Recorder, source, step_of
from streamtrack.settings import Settings
from streamtrack.types import Frame, Packet
info = replace(source(), packet_codec="mjpeg", is_live=True)
noise = np.random.default_rng(1).bytes(150_000)
with Recorder(Path(sys.argv[1]), info, Settings(), ["board"]) as recorder:
    for index in range(60):
        step = step_of(index)
        packets = (Packet(step.frame.time_s, noise, True),)
        recorder.log(replace(step, frame=replace(step.frame, packets=packets)))
        time.sleep(1 / 30)
    time.sleep(1.0)
    os._exit(9)
"""


def test_small_values_beside_large_pictures_survive_a_kill(tmp_path):
    tests = Path(__file__).parent
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tests), str(tests.parent)])}
    path = tmp_path / "run.rrd"
    subprocess.run([sys.executable, "-c", LARGE_RUN, str(path)], env=environment, check=False)
    assert "mended" in mend(path)
    assert rrd_columns(path, "/metrics/ms", "Scalars:scalars")[0] == list(range(60))


@pytest.mark.parametrize("cut", [0, 1000])
def test_the_next_run_mends_what_a_kill_left(tmp_path, killed, caplog, cut):
    left = tmp_path / "cam-000007.rrd"
    left.write_bytes(killed[: len(killed) - cut])
    os.utime(left, (1e9, 1e9))
    assert not is_whole(left)
    with Recorder(tmp_path / "cam.rrd", source(), rotating(rotate="1h"), []) as recorder:
        recorder.log(step_of(0, ()))
        deadline = time.monotonic() + 20
        while not is_whole(left) and time.monotonic() < deadline:
            time.sleep(0.05)
    frames, _ = rrd_columns(left, "/metrics/ms", "Scalars:scalars")
    assert frames == list(range(len(frames)))
    assert len(frames) >= 20
    assert len(RrdReader(left).blueprints()) == 1
    assert left.stat().st_mtime == pytest.approx(1e9)
    assert f"mended {left}" in caplog.text
    lines = rrd_columns(recorder.path, "/log", "TextLog:text")[1]
    assert any("mended" in line for (line,) in lines)
    assert [path.name for path in tmp_path.iterdir() if path.name.startswith(".")] == []


def test_mending_leaves_alone_what_it_must(tmp_path, killed):
    whole = tmp_path / "whole.rrd"
    with Recorder(whole, source(), rotating(), []):
        assert mend(whole) == ""  # held by the recorder
    data = whole.read_bytes()
    assert mend(whole) == ""
    assert whole.read_bytes() == data
    text = tmp_path / "text.rrd"
    text.write_text("this is no recording at all, whatever its name may say")
    assert "cannot be mended" in mend(text)
    assert text.read_text().startswith("this is no")
    empty = tmp_path / "empty.rrd"
    empty.touch()
    assert "removed" in mend(empty)
    assert not empty.exists()
    stopped = threading.Event()
    stopped.set()
    left = tmp_path / "left.rrd"
    left.write_bytes(killed)
    mend(left, stopped)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["left.rrd", "text.rrd", "whole.rrd"]


def test_without_the_viewer_nothing_is_mended(tmp_path, killed, monkeypatch):
    def refuse():
        raise OutputError("not installed")

    monkeypatch.setattr(repair, "viewer_executable", refuse)
    left = tmp_path / "left.rrd"
    left.write_bytes(killed)
    assert "not installed" in mend(left)
    assert left.read_bytes() == killed


@pytest.mark.slow
def test_memory_threads_and_files_stay_flat_over_many_files(tmp_path):
    """Rerun leaves two threads and 2.5 MB behind for each layout that is given to it."""
    settings = rotating(rotate="1s", keep="3s")
    with Recorder(tmp_path / "cam.rrd", source(rate_hz=2.0), settings, ["board"]) as recorder:
        counts = []
        for index in range(120):
            recorder.log(step_of(index, time_s=float(index)))
            if index >= 20 and index % 20 == 0:
                threads = len(list(Path("/proc/self/task").iterdir()))
                counts.append((threads, len(list(Path("/proc/self/fd").iterdir()))))
    assert len(set(counts)) <= 2
    assert np.ptp(np.array(counts), axis=0).max() <= 2


def test_log_lines_of_other_threads_never_block_the_tracker(tmp_path):
    """One thread logs (handler, then recorder), the other records and logs (the other way)."""
    end = threading.Event()

    def chatter():
        while not end.is_set():
            logging.getLogger("streamtrack.sources").warning("hello")

    recorder = Recorder(tmp_path / "log.rrd", source(), rotating(), [])
    worker = threading.Thread(
        target=lambda: [_log_inside(recorder, index) for index in range(60)], daemon=True
    )
    chatterer = threading.Thread(target=chatter, daemon=True)
    chatterer.start()
    worker.start()
    worker.join(20)
    end.set()
    assert not worker.is_alive()
    chatterer.join(5)
    recorder.close()


def _log_inside(recorder, index):
    with recorder._lock:
        time.sleep(0.0002)
        logging.getLogger("streamtrack.recording.recorder").warning("%d", index)


def test_series_survive_a_file_that_vanishes(tmp_path, monkeypatch):
    make_files(tmp_path, ["cam-000001.rrd", "cam-000002.rrd"], size=2000)
    series = FileSeries(tmp_path / "cam.rrd")
    original = rotation.is_in_use

    def vanish(path):
        result = original(path)
        path.unlink(missing_ok=True)
        return result

    monkeypatch.setattr(rotation, "is_in_use", vanish)
    assert len(series.remove_beyond(Limit(10))) == 2
