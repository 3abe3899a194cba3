from __future__ import annotations

import io
import logging
import math
import os
import signal
import subprocess
import sys
import threading
import time
import warnings
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace

import av
import cv2
import numpy as np
import pytest
import rerun.blueprint as rrb
from rerun.chunk import RrdReader
from rrd import rrd_columns, rrd_entities, rrd_timelines

import streamtrack.recording.recorder as recording
import streamtrack.recording.video as recorded_video
import streamtrack.viewer as viewer
from streamtrack.errors import OutputError, SourceError
from streamtrack.geometry import box_quad, transform_points, translation
from streamtrack.recording import blueprint
from streamtrack.recording.entities import TargetEntities
from streamtrack.recording.recorder import Recorder, view
from streamtrack.settings import Settings, build_settings
from streamtrack.types import (
    CameraPose,
    Evidence,
    Features,
    Frame,
    Model,
    Packet,
    SourceInfo,
    Step,
    Track,
    TrackState,
)

SIZE = (160, 120)
RATE = 25.0
BOX = box_quad(20, 20, 60, 40)
POINTS = np.array([[25, 25], [40, 30], [60, 40], [70, 50], [75, 55]], np.float32)
IS_INLIER = np.array([True, True, False, True, True])
LOOSE = np.array([[100, 100], [110, 100]], np.float32)
LOST = range(6, 9)
BLOB = "EncodedImage:blob"


@pytest.fixture(autouse=True)
def ffmpeg_is_there(monkeypatch):
    monkeypatch.setattr(recorded_video.shutil, "which", lambda name: f"/bin/{name}")


def picture(index):
    rng = np.random.default_rng(0)
    coarse = rng.integers(0, 255, (15, 24, 3), dtype=np.uint8)
    wide = cv2.resize(coarse, (240, 150), interpolation=cv2.INTER_CUBIC)
    return np.ascontiguousarray(wide[: SIZE[1], index % 60 : index % 60 + SIZE[0]])


def tracked(name, index):
    pose = translation(2.0 * index, 1.0 * index)
    evidence = Evidence(POINTS, transform_points(pose, POINTS), IS_INLIER, LOOSE)
    quad = transform_points(pose, BOX)
    return Track(
        name, TrackState.TRACKING, quad, pose, Model.HOMOGRAPHY, evidence, 0.25, 0.9, "flow"
    )


def step_of(index, names=("board",), packets=(), image=None, lost=LOST, time_s=None):
    tracks = tuple(
        Track(name, TrackState.LOST, reason="too few inliers")
        if index in lost
        else tracked(name, index)
        for name in names
    )
    frame = Frame(
        index,
        index / RATE if time_s is None else time_s,
        picture(index) if image is None else image,
        packets=tuple(packets),
    )
    return Step(frame, tracks, CameraPose(np.eye(3)), None, {"total": 3.0, "flow": 2.0})


def source(**changes):
    values = {"uri": "clip.mp4", "size_wh": SIZE, "rate_hz": RATE, "frame_count": None}
    return SourceInfo(**{**values, **changes})


def video_settings(mode):
    return build_settings({"recording": {"video": mode}})


def record(path, info=None, settings=None, names=("board",), count=12, **kwargs):
    with Recorder(
        path, info or source(), settings or Settings(), list(names), **kwargs
    ) as recorder:
        for index in range(count):
            recorder.log(step_of(index, names))
    return recorder


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    path = tmp_path_factory.mktemp("recording") / "new" / "folder" / "run.rrd"
    record(path)
    return path


def encode_clip(count, has_b_frames=False):
    """An H.264 MP4 file of the pictures 0 .. count-1."""
    file = io.BytesIO()
    with av.open(file, "w", format="mp4") as container:
        stream = container.add_stream("libx264", rate=Fraction(25))
        stream.width, stream.height = SIZE
        stream.pix_fmt = "yuv420p"
        stream.codec_context.max_b_frames = 3 if has_b_frames else 0
        stream.options = {"preset": "medium" if has_b_frames else "ultrafast", "g": "10"}
        for index in range(count):
            frame = av.VideoFrame.from_ndarray(picture(index), format="bgr24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return file.getvalue()


def annex_b_packets(data):
    with av.open(io.BytesIO(data)) as container:
        stream = container.streams.video[0]
        to_annex_b = av.bitstream.BitStreamFilterContext("h264_mp4toannexb", stream)
        return [
            Packet(float(packet.pts * stream.time_base), bytes(packet), packet.is_keyframe)
            for demuxed in container.demux(stream)
            if demuxed.pts is not None
            for packet in to_annex_b.filter(demuxed)
        ]


def blob(value):
    return np.asarray(value[0], np.uint8).tobytes()


def decode_samples(codec, samples):
    decoder = av.CodecContext.create(codec, "r")
    pictures = []
    for sample in samples:
        pictures += decoder.decode(av.Packet(blob(sample)))
    pictures += decoder.decode(None)
    return [one.to_ndarray(format="bgr24") for one in pictures]


def assert_similar(a, b):
    assert cv2.PSNR(np.asarray(a), np.asarray(b)) > 25


def test_entities_of_the_contract_are_there(recorded):
    assert {
        "/camera/image",
        "/camera/keypoints",
        "/camera/matches",
        "/camera/targets/board/quad",
        "/camera/targets/board/corners",
        "/targets/board/state",
        "/targets/board/view",
        "/targets/board/template",
        "/metrics/board/matches",
        "/metrics/board/inliers",
        "/metrics/board/rmse_px",
        "/metrics/board/correlation",
        "/metrics/ms",
        "/metrics/ms/flow",
        "/summary",
        "/log",
    } <= set(rrd_entities(recorded))


def test_layout_and_properties_are_embedded(recorded):
    reader = RrdReader(recorded)
    assert reader.blueprints()
    (store,) = reader.recordings()
    assert store.application_id == "streamtrack"
    expected = {
        "source": "clip.mp4",
        "detector": "harris",
        "descriptor": "freak",
        "width": 160,
        "height": 120,
        "rate_hz": 25.0,
        "settings": Settings().model_dump_json(),
    }
    for name, value in expected.items():
        assert rrd_columns(recorded, "/__properties/run", name, None)[1] == [[value]]
    names = rrd_columns(recorded, "/__properties", "RecordingInfo:name", None)[1]
    assert names == [["clip.mp4"]]


def test_timelines(recorded, tmp_path):
    assert rrd_timelines(recorded, "/camera/keypoints") == {"frame", "video_time"}
    live = tmp_path / "live.rrd"
    record(live, source(is_live=True), count=2)
    assert rrd_timelines(live, "/camera/keypoints") == {"frame", "video_time", "capture_time"}
    times, _ = rrd_columns(live, "/metrics/ms", "Scalars:scalars", "capture_time")
    assert abs(times[0] / 1e9 - time.time()) < 60
    assert times[1] - times[0] == pytest.approx(1e9 / RATE, abs=1000)


def test_quads_and_corners_are_the_tracks(recorded):
    shown = [index for index in range(12) if index not in LOST]
    frames, strips = rrd_columns(recorded, "/camera/targets/board/quad", "LineStrips2D:strips")
    assert frames == shown
    for index, (strip,) in zip(frames, strips, strict=True):
        quad = tracked("board", index).quad
        np.testing.assert_array_equal(strip, [*quad, quad[0]])
    frames, corners = rrd_columns(recorded, "/camera/targets/board/corners", "Points2D:positions")
    assert frames == shown
    np.testing.assert_array_equal(corners[-1], tracked("board", 11).quad)
    times, _ = rrd_columns(
        recorded, "/camera/targets/board/quad", "LineStrips2D:strips", "video_time"
    )
    assert times == [round(1e9 * index / RATE) for index in shown]


def test_drawings_are_cleared_once_on_loss(recorded):
    frames, _ = rrd_columns(recorded, "/camera/targets/board", "Clear:is_recursive")
    assert frames == [LOST.start]


def test_points_and_lines(recorded):
    frames, positions = rrd_columns(recorded, "/camera/keypoints", "Points2D:positions")
    classes = rrd_columns(recorded, "/camera/keypoints", "Points2D:class_ids")[1]
    assert frames == [*range(LOST.start + 1), *range(LOST.stop, 12)]
    np.testing.assert_array_equal(
        positions[2], [*LOOSE, *transform_points(translation(4, 2), POINTS)]
    )
    assert classes[2] == [3, 3, 1, 1, 2, 1, 1]
    assert positions[LOST.start] == []
    lines = dict(zip(*rrd_columns(recorded, "/camera/matches", "LineStrips2D:strips"), strict=True))
    after = transform_points(translation(4, 2), POINTS)
    before = transform_points(translation(2, 1), POINTS)
    np.testing.assert_array_equal(lines[2], np.stack([before, after], axis=1))
    found_again = transform_points(translation(18, 9), POINTS)
    np.testing.assert_array_equal(lines[9], np.stack([POINTS, found_again], axis=1))


def test_features_are_unmatched_points(tmp_path):
    features = Features(
        np.array([[5, 6]], np.float32),
        np.ones(1, np.float32),
        np.ones(1, np.float32),
        np.zeros((1, 64), np.uint8),
    )
    frame = Frame(0, 0.0, picture(0))
    path = tmp_path / "features.rrd"
    with Recorder(path, source(), Settings(), []) as recorder:
        recorder.log(Step(frame, (), CameraPose(None), features, {}))
    assert rrd_columns(path, "/camera/keypoints", "Points2D:positions")[1] == [[[5.0, 6.0]]]
    assert rrd_columns(path, "/camera/keypoints", "Points2D:class_ids")[1] == [[3]]
    assert rrd_columns(path, "/metrics/features", "Scalars:scalars") == ([0], [[1.0]])


def test_lines_need_a_target_from_the_video(tmp_path):
    path = tmp_path / "template.rrd"
    with Recorder(path, source(), Settings(), ["board"], {"board": picture(0)}) as recorder:
        recorder.log(step_of(3))
    assert rrd_columns(path, "/camera/matches", "LineStrips2D:strips")[1] == [[]]


def test_state_changes_and_log_lines(recorded):
    changes = rrd_columns(recorded, "/targets/board/state", "StateChange:state")
    assert changes == ([0, 6, 9], [["tracking"], ["lost"], ["tracking"]])
    frames, lines = rrd_columns(recorded, "/log", "TextLog:text")
    assert frames == [0, 6, 9]
    assert lines[1] == ["frame 6: board tracking -> lost: too few inliers"]
    levels = rrd_columns(recorded, "/log", "TextLog:level")[1]
    assert levels == [["INFO"], ["WARN"], ["INFO"]]


def test_curves_have_gaps_while_lost(recorded):
    frames, inliers = rrd_columns(recorded, "/metrics/board/inliers", "Scalars:scalars")
    assert frames == list(range(12))
    for index, (value,) in enumerate(inliers):
        assert math.isnan(value) if index in LOST else value == 4
    rmse = rrd_columns(recorded, "/metrics/board/rmse_px", "Scalars:scalars")[1]
    assert rmse[0] == [0.25]
    assert rrd_columns(recorded, "/metrics/ms", "Scalars:scalars")[1] == [[3.0]] * 12
    assert rrd_columns(recorded, "/metrics/ms/flow", "Scalars:scalars")[1] == [[2.0]] * 12


def test_close_up_shows_the_target_upright(recorded):
    frames, views = rrd_columns(recorded, "/targets/board/view", BLOB)
    assert frames == [0, 5, LOST.start, 9]
    blank = cv2.imdecode(np.frombuffer(blob(views[2]), np.uint8), cv2.IMREAD_COLOR)
    assert blank.shape == (41, 61, 3)
    assert np.ptp(blank) == 0
    (template,) = rrd_columns(recorded, "/targets/board/template", BLOB, None)[1]
    assert blob(template) == blob(views[0])
    now = cv2.imdecode(np.frombuffer(blob(views[1]), np.uint8), cv2.IMREAD_COLOR)
    x, y = 20 + 2 * 5, 20 + 5
    assert_similar(now, picture(5)[y : y + 41, x : x + 61])


def test_given_template_is_shown_small(tmp_path):
    large = cv2.resize(picture(0), (640, 480))
    path = tmp_path / "template.rrd"
    record(path, count=1, template_views={"board": large})
    (template,) = rrd_columns(path, "/targets/board/template", BLOB, None)[1]
    shown = cv2.imdecode(np.frombuffer(blob(template), np.uint8), cv2.IMREAD_COLOR)
    assert shown.shape == (120, 160, 3)


def test_jpeg_is_the_picture(recorded):
    frames, pictures = rrd_columns(recorded, "/camera/image", BLOB)
    assert frames == list(range(12))
    shown = cv2.imdecode(np.frombuffer(blob(pictures[7]), np.uint8), cv2.IMREAD_COLOR)
    assert_similar(shown, picture(7))


def test_pictures_of_changing_size(tmp_path):
    for mode in ("jpeg", "av1"):
        path = tmp_path / f"{mode}.rrd"
        with Recorder(path, source(), video_settings(mode), []) as recorder:
            for index in range(6):
                image = picture(index) if index < 3 else picture(index)[:100, :, 0]
                recorder.log(step_of(index, (), image=np.ascontiguousarray(image)))
        component = BLOB if mode == "jpeg" else "VideoStream:sample"
        assert rrd_columns(path, "/camera/image", component)[0] == list(range(6))


def test_no_video(tmp_path):
    path = tmp_path / "none.rrd"
    record(path, source(packet_codec="h264"), video_settings("none"), count=2)
    assert "/camera/image" not in rrd_entities(path)


def test_packets_are_copied(tmp_path):
    packets = annex_b_packets(encode_clip(20))
    path = tmp_path / "packets.rrd"
    with Recorder(path, source(packet_codec="h264"), Settings(), []) as recorder:
        for index, packet in enumerate(packets):
            recorder.log(step_of(index, (), [packet]))
    frames, samples = rrd_columns(path, "/camera/image", "VideoStream:sample")
    assert frames == list(range(20))
    assert [blob(sample) for sample in samples] == [packet.data for packet in packets]
    keys = rrd_columns(path, "/camera/image", "VideoStream:is_keyframe")[1]
    assert [key for (key,) in keys] == [packet.is_keyframe for packet in packets]
    pictures = decode_samples("h264", samples)
    assert len(pictures) == 20
    assert_similar(pictures[13], picture(13))


def test_packets_between_steps_and_of_a_late_decoder(tmp_path):
    """Frames 4 and 9 are yielded, with two packets that belong to pictures still to come."""
    packets = annex_b_packets(encode_clip(12))
    path = tmp_path / "steps.rrd"
    with Recorder(path, source(packet_codec="h264"), Settings(), []) as recorder:
        recorder.log(step_of(4, (), packets[:7]))
        recorder.log(step_of(9, (), packets[7:]))
    frames, samples = rrd_columns(path, "/camera/image", "VideoStream:sample")
    assert frames == list(range(12))
    assert [blob(sample) for sample in samples] == [packet.data for packet in packets]
    times, _ = rrd_columns(path, "/camera/image", "VideoStream:sample", "video_time")
    assert times == pytest.approx([1e9 * index / RATE for index in range(12)], abs=1)


def test_packets_of_equal_times_get_increasing_ones(tmp_path):
    path = tmp_path / "equal.rrd"
    packets = [Packet(0.0, bytes([number]), number == 0) for number in range(3)]
    with Recorder(path, source(packet_codec="vp9"), Settings(), []) as recorder:
        recorder.log(step_of(0, (), packets))
    assert rrd_columns(path, "/camera/image", "VideoStream:sample")[0] == [0, 0, 0]
    times, samples = rrd_columns(path, "/camera/image", "VideoStream:sample", "video_time")
    assert len(set(times)) == 3
    assert [blob(sample) for sample in samples] == [packet.data for packet in packets]


def test_mjpeg_packets_are_copied_one_a_frame(tmp_path):
    data = [cv2.imencode(".jpg", picture(index))[1].tobytes() for index in range(4)]
    packets = [Packet(index / RATE, one, True) for index, one in enumerate(data)]
    path = tmp_path / "mjpeg.rrd"
    with Recorder(path, source(packet_codec="mjpeg"), Settings(), []) as recorder:
        recorder.log(step_of(1, (), packets[:3]))
        recorder.log(step_of(3, (), packets[3:]))
    frames, pictures = rrd_columns(path, "/camera/image", BLOB)
    assert frames == [1, 3]
    assert [blob(one) for one in pictures] == [data[1], data[3]]


def test_file_with_b_frames_is_embedded(tmp_path):
    clip = tmp_path / "clip.mp4"
    clip.write_bytes(encode_clip(20, has_b_frames=True))
    path = tmp_path / "asset.rrd"
    with Recorder(path, source(asset_path=clip), Settings(), []) as recorder:
        for index in range(0, 20, 3):
            recorder.log(step_of(index, ()))
    assert blob(rrd_columns(path, "/camera/image", "AssetVideo:blob", None)[1][0]) == (
        clip.read_bytes()
    )
    frames, times = rrd_columns(path, "/camera/image", "VideoFrameReference:timestamp")
    assert frames == list(range(0, 20, 3))
    steps = np.diff([value for (value,) in times])
    np.testing.assert_allclose(steps, 3 * 1e9 / RATE, atol=2)


@pytest.mark.parametrize("content", [b"no video at all", None])
def test_file_that_cannot_be_embedded_gives_jpeg(tmp_path, content):
    clip = tmp_path / "clip.mp4"
    if content:
        clip.write_bytes(content)
    path = tmp_path / "asset.rrd"
    record(path, source(asset_path=clip), count=2)
    assert len(rrd_columns(path, "/camera/image", BLOB)[0]) == 2


def test_file_that_is_too_large_gives_jpeg(tmp_path):
    clip = tmp_path / "clip.mp4"
    clip.write_bytes(encode_clip(3, has_b_frames=True))
    settings = build_settings({"recording": {"max_asset_mb": 0.0001}})
    path = tmp_path / "asset.rrd"
    record(path, source(asset_path=clip), settings, count=2)
    assert len(rrd_columns(path, "/camera/image", BLOB)[0]) == 2


def test_av1_is_decoded_to_the_pictures(tmp_path):
    path = tmp_path / "av1.rrd"
    record(path, settings=video_settings("av1"))
    frames, samples = rrd_columns(path, "/camera/image", "VideoStream:sample")
    assert frames == list(range(12))
    pictures = decode_samples("libdav1d", samples)
    assert len(pictures) == 12
    assert_similar(pictures[11], picture(11))


def test_missing_ffmpeg_is_told(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(recorded_video.shutil, "which", lambda _: None)
    record(tmp_path / "a.rrd", source(packet_codec="h264"), count=1)
    assert "ffmpeg" in caplog.text
    caplog.clear()
    record(tmp_path / "b.rrd", source(packet_codec="av1"), count=1)
    record(tmp_path / "c.rrd", count=1)
    assert "ffmpeg" not in caplog.text


def test_names_make_safe_and_different_paths(tmp_path):
    names = ["a b", "a/b", "a\\b", "ünï→", "a_b", "#1: x{}", "state", "__properties"]
    path = tmp_path / "names.rrd"
    record(path, names=names, count=2)
    quads = {entity for entity in rrd_entities(path) if entity.endswith("/quad")}
    assert len(quads) == len(names)
    for name in names:
        entity = TargetEntities.of(name).quad
        assert len(rrd_columns(path, entity, "LineStrips2D:strips")[0]) == 2
        assert rrd_columns(path, entity, "LineStrips2D:labels", None)[1] == [[name]]


def test_credentials_stay_out(tmp_path):
    path = tmp_path / "secret.rrd"
    record(path, source(uri="rtsp://me:secret@camera/stream?token=secret"), count=1)
    assert rrd_columns(path, "/__properties/run", "source", None)[1] == [["rtsp-camera-stream"]]
    assert b"secret" not in path.read_bytes()


def test_log_records_of_all_threads_go_in(tmp_path):
    path = tmp_path / "log.rrd"
    with Recorder(path, source(), Settings(), []) as recorder:
        recorder.log(step_of(5, ()))
        worker = threading.Thread(
            target=logging.getLogger("streamtrack.sources").warning, args=("%d gone", 3)
        )
        worker.start()
        worker.join()
        recorder.log_text("INFO", "hello")
    logging.getLogger("streamtrack.sources").warning("after the end")
    assert rrd_columns(path, "/log", "TextLog:text") == ([5, 5], [["3 gone"], ["hello"]])
    assert rrd_columns(path, "/log", "TextLog:level")[1] == [["WARN"], ["INFO"]]


def test_the_level_of_the_logger_is_given_back(tmp_path):
    logger = logging.getLogger("streamtrack")
    before = logger.level
    first = Recorder(tmp_path / "a.rrd", source(), Settings(), [])
    second = Recorder(tmp_path / "b.rrd", source(), Settings(), [])
    first.close()
    logging.getLogger("streamtrack.sources").info("only the second hears this")
    second.close()
    assert rrd_columns(tmp_path / "a.rrd", "/log", "TextLog:text")[1] == []
    assert len(rrd_columns(tmp_path / "b.rrd", "/log", "TextLog:text")[1]) == 1
    assert logger.level == before


def test_summary_is_replaced_at_the_end(tmp_path):
    path = tmp_path / "summary.rrd"
    recorder = Recorder(path, source(), Settings(), ["board"])
    recorder.close("# Done")
    recorder.close("# Twice")
    recorder.log(step_of(0))
    texts = rrd_columns(path, "/summary", "TextDocument:text", None)[1]
    assert texts[-1] == ["# Done"]
    assert "board" in texts[0][0]


def test_exception_leaves_a_whole_file(tmp_path):
    path = tmp_path / "broken.rrd"
    with pytest.raises(ZeroDivisionError), Recorder(path, source(), Settings(), []) as recorder:
        recorder.log(step_of(0, ()))
        raise ZeroDivisionError
    assert len(rrd_columns(path, "/camera/image", BLOB)[0]) == 1


@pytest.mark.parametrize("place", ["file/run.rrd", ".", "/proc/run.rrd"])
def test_unwritable_place_is_refused(tmp_path, place):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="recording"):
        Recorder(tmp_path / place, source(), Settings(), [])
    assert not [
        handler
        for handler in logging.getLogger("streamtrack").handlers
        if type(handler).__module__ == recording.__name__
    ]


def test_capture_times_ages_and_epochs_of_a_live_source(tmp_path):
    path = tmp_path / "live.rrd"
    began = time.time()
    with Recorder(path, source(is_live=True), Settings(), []) as recorder:
        recorder.log_source("connecting")
        for index in range(4):
            recorder.log_source("streaming", {"dropped": index // 2, "lost": 0})
            step = step_of(index, ())
            captured = began - 100.0 + index
            frame = replace(step.frame, captured_unix_s=captured, epoch=index // 3)
            recorder.log(replace(step, frame=frame))
        recorder.log_source("stalled", time_s=3.5)
        recorder.log_source("streaming", time_s=9.0)
    times, ages = rrd_columns(path, "/metrics/age_ms", "Scalars:scalars", "capture_time")
    np.testing.assert_allclose(np.array(times) / 1e9, began - 100.0 + np.arange(4), atol=1e-4)
    assert 97e3 <= ages[3][0] <= 127e3
    states = rrd_columns(path, "/source/state", "StateChange:state")
    assert states[1] == [["connecting"], ["streaming"], ["stalled"], ["streaming"]]
    moments = rrd_columns(path, "/source/state", "StateChange:state", "video_time")[0]
    assert moments == [0, 0, 3_500_000_000, 9_000_000_000]
    dropped = rrd_columns(path, "/metrics/source/dropped", "Scalars:scalars")
    assert dropped == ([0, 1], [[0.0], [1.0]])
    lines = rrd_columns(path, "/log", "TextLog:text")
    assert lines == ([3], [["frame 3: the source began anew"]])


def test_targets_have_no_state_while_a_live_source_is_away(tmp_path):
    path = tmp_path / "live.rrd"
    with Recorder(path, source(is_live=True), Settings(), ["board"]) as recorder:
        recorder.log_source("streaming")
        for index in range(2):
            recorder.log(step_of(index))
        recorder.log_source("stalled", time_s=1.0)
        recorder.log_source("connecting", time_s=2.0)
        recorder.log_source("streaming", time_s=3.0)
        recorder.log(step_of(90))
    times, states = rrd_columns(path, "/targets/board/state", "StateChange:state", "video_time")
    assert states == [["tracking"], ["no picture"], ["tracking"]]
    assert times[0] < times[1] == 1_000_000_000 < times[2]


def test_a_file_that_another_run_writes_is_left_alone(tmp_path):
    path = tmp_path / "run.rrd"
    with Recorder(path, source(), Settings(), []) as recorder:
        recorder.log(step_of(0, ()))
        with pytest.raises(OutputError, match="another process"):
            Recorder(path, source(), Settings(), [])
    assert rrd_columns(path, "/camera/image", BLOB)[0] == [0]


def test_full_disk_ends_the_recording_but_not_the_run(tmp_path, monkeypatch, caplog):
    path = tmp_path / "full.rrd"
    free = {"blocks": 1 << 20}
    monkeypatch.setattr(
        os, "statvfs", lambda _: SimpleNamespace(f_bavail=free["blocks"], f_frsize=4096)
    )
    with Recorder(path, source(), Settings(), ["board"]) as recorder:
        recorder.log(step_of(0))
        free["blocks"] = 10
        for index in range(1, 4):
            recorder.log(step_of(index))
        assert recorder.failed == "the disk is full"
    assert caplog.text.count("the disk is full") == 1
    assert rrd_columns(path, "/camera/image", BLOB)[0] == [0]
    assert rrd_columns(path, "/log", "TextLog:text")[1][-1] == ["recording ended: the disk is full"]


KILLED_RUN = """
import sys, time
from pathlib import Path
from test_recording import Recorder, Settings, source, step_of
with Recorder(Path(sys.argv[1]), source(is_live=True), Settings(), ["board"]) as recorder:
    for index in range(1000):
        recorder.log(step_of(index))
        print(index, flush=True)
        time.sleep(1 / 30)
"""


def test_killed_run_leaves_all_but_the_last_moment(tmp_path):
    path = tmp_path / "killed.rrd"
    folder = Path(__file__).parent
    with subprocess.Popen(
        [sys.executable, "-c", KILLED_RUN, str(path)],
        stdout=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(folder), str(folder.parent)])},
        text=True,
    ) as process:
        assert process.stdout is not None
        last = 0
        for line in process.stdout:
            last = int(line)
            if last == 45:
                process.send_signal(signal.SIGKILL)
    mended = tmp_path / "mended.rrd"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        frames, _ = rrd_columns(path, "/metrics/ms", "Scalars:scalars")
    assert frames == list(range(len(frames)))
    assert len(frames) >= last - 9
    optimize = [str(viewer.viewer_executable()), "rrd", "optimize", str(path), "-o", str(mended)]
    subprocess.run(optimize, check=True, capture_output=True)
    assert rrd_columns(mended, "/metrics/ms", "Scalars:scalars")[0] == frames


@pytest.mark.parametrize("content", [None, b"", b"\x89PNG...."])
def test_view_refuses_what_is_no_recording(tmp_path, content):
    path = tmp_path / "x.rrd"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(SourceError, match=r"x\.rrd"):
        view(path, web=False, port=None)


def test_view_needs_a_screen_or_the_browser(recorded, monkeypatch):
    monkeypatch.setattr(viewer.sys, "platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(SourceError, match="--web"):
        view(recorded, web=False, port=None)


def test_view_listens_on_loopback_only(recorded, monkeypatch, capsys):
    calls = []

    class FakeProcess:
        def __init__(self, command):
            calls.append(command)

        def __enter__(self):
            return self

        def __exit__(self, *_):
            pass

        def wait(self):
            return 0

        def poll(self):
            return None

        def terminate(self):
            pass

    opened = []
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr(viewer.subprocess, "Popen", FakeProcess)
    monkeypatch.setattr(viewer, "_answers", lambda *_: True)
    monkeypatch.setattr(viewer.webbrowser, "open", opened.append)
    assert view(recorded, web=False, port=None) == 0
    assert view(recorded, web=True, port=9123) == 0
    for command in calls:
        assert command[command.index("--bind") + 1] == "127.0.0.1"
    assert opened[0].startswith("http://127.0.0.1:9123/?url=")
    assert opened[0] in capsys.readouterr().out


def views_below(part):
    """All views below a part of a layout."""
    if not isinstance(part, rrb.Container):
        return [part]
    return [view for one in part.contents for view in views_below(one)]


@pytest.mark.parametrize(
    ("names", "finds_targets", "has_tracks", "curves"),
    [
        (["a"], False, True, "Features, matches, inliers"),
        (["a"], True, True, "Features, matches, inliers"),
        ([], True, True, "Targets found"),
        ([], False, False, None),
    ],
)
def test_the_layout_has_no_panel_that_stays_empty(names, finds_targets, has_tracks, curves):
    for world in blueprint.World:
        layout = blueprint.build((64, 48), names, "frame", world, finds_targets=finds_targets)
        views = views_below(layout.root_container)
        assert len({id(view) for view in views}) == len(views)  # the viewer shows each only once
        shown = [view.name for view in views]
        assert ("Tracks" in shown) == has_tracks
        counted = {"Features, matches, inliers", "Targets found"} & set(shown)
        assert curves in counted if curves else not counted
        assert ("World" in shown) == (world is not blueprint.World.NONE)
