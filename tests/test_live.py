"""Tests of the loop around live devices: newest frames, losses, reopening, clocks and counts."""

from __future__ import annotations

import gc
import logging
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Self, TypeAlias

import numpy as np
import pytest

from streamtrack.errors import SourceError, UsageError
from streamtrack.meters import peak_rss_mb
from streamtrack.settings import LiveSettings
from streamtrack.sources import _backoff, _frame_queue
from streamtrack.sources._backoff import Backoff
from streamtrack.sources._epoch_clock import EpochClock
from streamtrack.sources._frame_queue import FrameQueue
from streamtrack.sources._thinner import Thinner
from streamtrack.sources.capture import (
    Captured,
    CaptureEndedError,
    CaptureFinishedError,
    CaptureRefusedError,
)
from streamtrack.sources.live import LiveSource
from streamtrack.sources.live_status import LiveState
from streamtrack.sources.network.arrival import ArrivalClock
from streamtrack.types import Frame, Packet, SourceInfo
from tests.servers import eventually

Act: TypeAlias = Captured | Exception | float | None
"""What a device does at a read: deliver, fail, pause for seconds, or have nothing in time."""


def captured(number: int, **more: Any) -> Captured:
    size = more.pop("size", (4, 6))
    return Captured(
        np.full((*size, 3), number, np.uint8), more.pop("time_s", number / 30), time.monotonic(),
        **more,
    )  # fmt: skip


class Device:
    """A capture that acts by a script, then is silent."""

    def __init__(self, acts: Iterable[Act], *, is_live: bool = True, codec: str | None = None):
        self._acts = iter(acts)
        self.info = SourceInfo("device", (6, 4), 30.0, None, is_live, codec)
        self.is_closed = False

    def read(self, timeout_s: float) -> Captured | None:
        act = next(self._acts, None)
        if isinstance(act, float):
            time.sleep(act)
            return self.read(timeout_s)
        if isinstance(act, Exception):
            raise act
        if act is None:
            time.sleep(min(timeout_s, 0.01))
        return act

    def close(self) -> None:
        self.is_closed = True

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *raised: object) -> None:
        self.close()


class Opener:
    """Gives one device after the other, or raises; then raises for ever."""

    def __init__(self, *devices: Device | Exception) -> None:
        self._devices = iter(devices)
        self.calls = 0

    def __call__(self, is_stopping: Callable[[], bool]) -> Device:
        self.calls += 1
        device = next(self._devices, None)
        if device is None:
            device = SourceError("nothing there")
        if isinstance(device, Exception):
            raise device
        return device


def live(*devices: Device | Exception, **more: Any) -> LiveSource:
    settings = LiveSettings(**more.pop("settings", {}))
    opener = more.pop("opener", None) or Opener(*devices)
    return LiveSource(opener, settings, name="cam", **more)


def paced(numbers: Iterable[int], pause_s: float = 0.005, **more: Any) -> Iterator[Act]:
    """Pictures slower than any reader."""
    for number in numbers:
        yield captured(number, **more)
        yield pause_s


def take(source: LiveSource, count: int) -> list[Frame]:
    frames = []
    for frame in source:
        frames.append(frame)
        if len(frames) == count:
            break
    return frames


@pytest.fixture(autouse=True)
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_backoff, "_FIRST_S", 0.01)
    monkeypatch.setattr(_backoff, "_LONGEST_S", 0.05)


# -- frames -------------------------------------------------------------------------------------


def test_frames_come_in_order_with_their_times_and_count() -> None:
    with live(Device(paced(range(10)))) as source:
        assert source.info.is_live
        before = time.monotonic()
        frames = take(source, 10)
    assert [int(f.image[0, 0, 0]) for f in frames] == list(range(10))
    assert [f.index for f in frames] == list(range(10))
    np.testing.assert_allclose([f.time_s for f in frames], np.arange(10) / 30, atol=1e-9)
    for frame in frames:
        assert frame.captured_s is not None and frame.captured_unix_s is not None
        assert abs(frame.captured_s - before) < 5
        wall_s = time.time() - time.monotonic() + frame.captured_s
        assert frame.captured_unix_s == pytest.approx(wall_s, abs=0.05)


def test_a_slow_reader_gets_the_newest_and_the_rest_is_counted() -> None:
    acts = [captured(0), 0.05, *(captured(n) for n in range(1, 50))]
    with live(Device(acts)) as source:
        frames = iter(source)
        assert next(frames).index == 0
        assert eventually(lambda: source.status().captured == 50)
        # Two may wait after a hiccup; the newest is the last captured.
        assert [next(frames).index, next(frames).index] == [48, 49]
        assert source.status().dropped == 47


def test_frames_of_a_slow_reader_are_hardly_older_than_a_period() -> None:
    period_s, work_s = 0.01, 0.035
    with live(Device(paced(range(200), period_s))) as source:
        for frame in source:
            time.sleep(work_s)
            source.note_output(frame)
            if frame.index > 60:
                break
        status = source.status()
    assert status.dropped > 20
    assert status.age_ms_p50 is not None and status.age_ms_p95 is not None
    # Its own work and a period; a queue of two worked off in order would add 20 ms.
    assert work_s * 1e3 <= status.age_ms_p50 < (work_s + 1.5 * period_s) * 1e3


def test_a_finished_file_is_read_whole_however_slow_the_reader() -> None:
    end = CaptureFinishedError("over")
    device = Device([*(captured(n) for n in range(30)), end], is_live=False)
    with live(device) as source:
        frames = []
        for frame in source:
            frames.append(frame)
            time.sleep(0.002)
        assert source.status().dropped == 0
        assert source.status().openings == 1
    assert [f.index for f in frames] == list(range(30))
    assert all(f.captured_s is None for f in frames)


def test_a_finished_file_that_breaks_off_is_not_begun_again() -> None:
    acts = [*(captured(n) for n in range(9)), CaptureEndedError("cam: hung up")]
    device = Device(acts, is_live=False)
    with live(device) as source:
        assert len(take(source, 9)) == 9
    with live(Device([captured(0), CaptureEndedError("cam: hung up")], is_live=False)) as source:
        with pytest.raises(SourceError, match="hung up: the file was not read to its end"):
            list(source)
        assert source.status().openings == 1


def test_every_picture_of_a_live_stream_is_read_if_so_wanted() -> None:
    acts = [*(captured(n) for n in range(30)), CaptureFinishedError("over")]
    with live(Device(acts), settings={"newest_only": False}) as source:
        frames = []
        for frame in source:
            frames.append(frame)
            time.sleep(0.002)
    assert [f.index for f in frames] == list(range(30))


def test_what_the_device_left_out_is_counted_and_keeps_its_numbers() -> None:
    acts = [
        captured(0),
        0.02,
        captured(1, lost=3),
        0.02,
        captured(2, damaged=2, dropped=1, thinned=4),
    ]
    with live(Device(acts)) as source:
        frames = take(source, 3)
        status = source.status()
    assert [f.index for f in frames] == [0, 4, 12]
    assert (status.lost, status.damaged, status.dropped, status.thinned) == (3, 2, 1, 4)
    assert source.corrupt_packets == 2


def test_packets_of_frames_left_out_come_with_the_next() -> None:
    def with_packet(number: int) -> Captured:
        return captured(number, packets=(Packet(number / 30, bytes([number]), number % 10 == 0),))

    acts = [with_packet(0), 0.05, *(with_packet(n) for n in range(1, 40))]
    device = Device(acts, codec="h264")
    with live(device, settings={"max_fps": 15}) as source:
        frames = iter(source)
        got = [next(frames)]
        assert eventually(lambda: source.status().captured + source.status().thinned == 40)
        got += [next(frames), next(frames)]
        assert source.status().thinned == 20
    data = b"".join(p.data for f in got for p in f.packets)
    assert data == bytes(range(len(data)))
    assert len(data) >= 38  # The last may wait for the picture after it.
    times = [p.time_s for f in got for p in f.packets]
    np.testing.assert_allclose(times, np.arange(len(times)) / 30, atol=1e-6)


def test_jpegs_of_frames_left_out_are_left_out_too() -> None:
    def with_packet(number: int) -> Captured:
        return captured(number, packets=(Packet(number / 30, bytes([number]), True),))

    device = Device([with_packet(n) for n in range(40)], codec="mjpeg")
    with live(device, settings={"max_fps": 15}) as source:
        assert eventually(lambda: source.status().captured + source.status().thinned == 40)
        for frame in take(source, 2):
            assert [p.data for p in frame.packets] == [bytes([frame.index])]


def test_packets_are_kept_for_a_while_then_from_the_last_keyframe(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("streamtrack.sources._frame_queue._MAX_PACKETS", 10)
    queue = FrameQueue()
    for n in range(18):
        queue.put(
            replace(frame(n), packets=(Packet(n / 30, bytes([n]), n % 8 == 0),)), may_drop=True
        )
    first = queue.get(lambda: False)
    assert first is not None and first.index == 16
    assert [p.data[0] for p in first.packets] == [8, 9, 10, 11, 12, 13, 14, 15, 16]


def test_max_fps_thins_evenly() -> None:
    with live(Device(paced(range(60), 0.002)), settings={"max_fps": 10}) as source:
        frames = take(source, 18)
        assert source.status().thinned > 30
    assert {b.index - a.index for a, b in pairwise(frames)} == {3}


# -- losing and finding again -------------------------------------------------------------------


def test_a_stream_that_breaks_off_is_opened_again_as_a_new_epoch(
    caplog: pytest.LogCaptureFixture,
) -> None:
    acts = [act for n in range(5) for act in (captured(n, time_s=n / 1000), 0.005)]
    first = Device([*acts, CaptureEndedError("cam: unplugged")])
    # The device's clock begins anew, and its picture is larger.
    second = Device(paced(range(5), size=(8, 10)))
    with caplog.at_level(logging.WARNING), live(first, SourceError("busy"), second) as source:
        frames = take(source, 10)
        status, events = source.status(), source.drain_events()
    assert first.is_closed and second.is_closed
    assert [f.epoch for f in frames] == [0] * 5 + [1] * 5
    assert [f.size_wh for f in frames] == [(6, 4)] * 5 + [(10, 8)] * 5
    assert [f.index for f in frames] == list(range(10))
    times = [f.time_s for f in frames]
    assert all(b > a for a, b in pairwise(times))
    # The gap is as long as it was, whatever the device's clock says.
    assert frames[5].captured_s is not None and frames[0].captured_s is not None
    elapsed_s = frames[5].captured_s - frames[0].captured_s
    assert times[5] - times[0] == pytest.approx(elapsed_s, abs=1e-6)
    np.testing.assert_allclose(np.diff(times[5:]), 1 / 30, atol=1e-9)
    assert (status.openings, status.reconnects, status.failed_openings) == (2, 1, 1)
    assert status.away_s > 0
    assert [e.state.value for e in events] == [
        *("connecting", "streaming", "waiting", "connecting", "waiting"),
        *("connecting", "streaming"),
    ]
    assert [e.epoch for e in events] == [0] * 6 + [1]
    assert all(b.unix_s >= a.unix_s for a, b in pairwise(events))
    assert events[2].detail == "cam: unplugged"
    text = caplog.text
    assert "cam: unplugged: trying again in" in text and "streaming again after" in text
    assert source.drain_events()[-1].state is LiveState.ENDED


def test_what_broke_off_is_gone_at_once() -> None:
    """Not only when garbage is collected: in runs of days that may never happen."""

    def open_device(is_stopping: Callable[[], bool]) -> Device:
        return Device([captured(1), CaptureEndedError("unplugged")])

    gc.collect()
    gc.disable()
    try:
        with live(opener=open_device) as source:
            assert eventually(lambda: source.status().openings > 20)
            kept = [item for item in gc.get_objects() if isinstance(item, Device)]
            assert len(kept) <= 2
    finally:
        gc.enable()


def test_a_silent_stream_is_given_up_and_opened_again() -> None:
    first = Device(paced(range(3)))
    with live(first, Device(paced(range(3))), settings={"stall_timeout_s": 0.1}) as source:
        began = time.monotonic()
        frames = take(source, 6)
        assert 0.1 < time.monotonic() - began < 1.5
        states = [e.state for e in source.drain_events()]
        assert source.status().stalls == 1
        assert source.status().away_s > 0.1  # the silence before it was noticed counts
    assert first.is_closed
    assert [f.epoch for f in frames] == [0] * 3 + [1] * 3
    assert LiveState.STALLED in states


def test_a_pause_below_the_stall_timeout_is_no_stall() -> None:
    acts = [captured(0), None, None, None, captured(1)]
    with live(Device(acts), settings={"stall_timeout_s": 5}) as source:
        assert [f.epoch for f in take(source, 2)] == [0, 0]
        assert source.status().stalls == 0


def test_another_size_in_mid_stream_begins_an_epoch() -> None:
    acts = [captured(0), 0.02, captured(1, size=(8, 8)), 0.02, captured(2, size=(8, 8))]
    with live(Device(acts)) as source:
        frames = take(source, 3)
    assert [f.epoch for f in frames] == [0, 1, 1]
    assert frames[1].time_s == pytest.approx(1 / 30)


def test_packets_of_another_codec_are_not_passed_on() -> None:
    def acts() -> list[Act]:
        packet = Packet(0.0, b"x", True)
        return [captured(0, packets=(packet,)), 0.02, CaptureEndedError("gone")]

    with live(Device(acts(), codec="h264"), Device(acts(), codec="hevc")) as source:
        frames = take(source, 2)
    assert [len(f.packets) for f in frames] == [1, 0]


def test_the_first_opening_is_tried_again_like_any_other() -> None:
    opener = Opener(SourceError("not yet"), SourceError("not yet"), Device(paced(range(3))))
    with live(opener=opener) as source:
        assert len(take(source, 3)) == 3
        assert source.status().failed_openings == 2
    assert opener.calls == 3


@pytest.mark.parametrize("retries", [0, 3])
def test_retries_are_counted_in_a_row(retries: int) -> None:
    opener = Opener()
    with pytest.raises(SourceError, match="nothing there"):
        live(opener=opener, settings={"retries": retries})
    assert opener.calls == retries + 1


def test_frames_before_the_last_loss_are_read_before_it_is_told() -> None:
    device = Device([*paced(range(5)), CaptureEndedError("gone")])
    got = []
    with live(device, settings={"retries": 2}) as source:
        with pytest.raises(SourceError, match=r"nothing there \(given up after 3 tries\)"):
            got.extend(source)
        assert source.status().state is LiveState.ENDED
    assert len(got) == 5


def test_a_stream_that_held_for_a_while_has_all_its_retries_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("streamtrack.sources.live._STEADY_S", 0.02)
    short = [Device([captured(0), CaptureEndedError("gone")]) for _ in range(3)]
    long = [Device([*paced(range(20)), CaptureEndedError("gone")]) for _ in range(6)]
    opener = Opener(*long, *short)
    with live(opener=opener, settings={"retries": 2}) as source, pytest.raises(SourceError):
        list(source)
    assert opener.calls == 6 + 2  # Each long one may fail twice; the short ones are failures.


def test_what_cannot_be_right_is_not_tried_again() -> None:
    opener = Opener(UsageError("no such format"))
    with pytest.raises(UsageError, match="no such format"):
        live(opener=opener)
    assert opener.calls == 1


def test_a_mistake_in_a_capture_ends_in_one_line() -> None:
    with pytest.raises(SourceError, match="cam: RuntimeError: oh"):
        live(Device([RuntimeError("oh")]))


def test_a_refusing_peer_is_asked_rarely(caplog: pytest.LogCaptureFixture) -> None:
    backoff = Backoff(None, 1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_backoff, "_LONGEST_S", 60.0)
        assert (backoff.next_delay_s(is_refused=True) or 0) > 45
    refused = CaptureRefusedError("cam: wrong password")
    with live(refused, Device(paced(range(1)))) as source:
        assert len(take(source, 1)) == 1
    assert "wrong password: trying again" in caplog.text


def test_a_long_absence_fills_no_log(caplog: pytest.LogCaptureFixture) -> None:
    with pytest.raises(SourceError):
        live(opener=Opener(), settings={"retries": 40})
    assert len(caplog.records) == 3 + 4  # 1, 2, 3, then 4, 8, 16, 32


# -- ending -------------------------------------------------------------------------------------


def test_a_wish_to_stop_ends_the_waiting_for_the_first_picture() -> None:
    began = time.monotonic()
    with pytest.raises(SourceError, match="interrupted before the first picture"):
        live(should_stop=lambda: time.monotonic() - began > 0.2)
    assert time.monotonic() - began < 1.5


def test_a_wish_to_stop_ends_the_waiting_for_a_lost_stream() -> None:
    wish = threading.Event()
    device = Device([*paced(range(3)), CaptureEndedError("gone")])
    with live(device, should_stop=wish.is_set) as source:
        timer = threading.Timer(0.3, wish.set)
        timer.start()
        began = time.monotonic()
        assert len(list(source)) == 3
        assert time.monotonic() - began < 1.5
        timer.join()


def test_another_thread_may_close_it() -> None:
    with live(Device(paced(range(3)))) as source:
        timer = threading.Timer(0.2, source.close)
        timer.start()
        assert len(list(source)) == 3
        timer.join()


def test_an_interrupt_while_waiting_leaves_nothing() -> None:
    def interrupt() -> bool:
        raise KeyboardInterrupt

    before = threading.active_count()
    with pytest.raises(KeyboardInterrupt):
        live(should_stop=interrupt)
    assert eventually(lambda: threading.active_count() == before)


def test_it_is_read_once() -> None:
    with live(Device(paced(range(3)))) as source:
        take(source, 1)
        with pytest.raises(SourceError, match="already read or closed"):
            iter(source)


def test_a_device_that_does_not_let_go_is_left_to_itself(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("streamtrack.sources.live._JOIN_TIMEOUT_S", 0.1)
    release = threading.Event()

    class Hung(Device):
        def read(self, timeout_s: float) -> Captured | None:
            got = super().read(timeout_s)
            return got if got is not None else (release.wait(10) and None)

    source = live(Hung([captured(0)]))
    began = time.monotonic()
    source.close()
    assert time.monotonic() - began < 1
    assert "does not let go" in caplog.text
    release.set()


def test_a_thousand_failed_openings_leave_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_backoff, "_FIRST_S", 1e-5)
    monkeypatch.setattr(_backoff, "_LONGEST_S", 2e-5)
    logging.getLogger("streamtrack.sources").setLevel(logging.ERROR)

    def try_often(retries: int) -> None:
        with pytest.raises(SourceError):
            live(opener=Opener(), settings={"retries": retries})

    def standing() -> tuple[int, int]:
        gc.collect()
        return len(list(Path("/proc/self/fd").iterdir())), threading.active_count()

    try_often(100)
    before, rss_mb = standing(), peak_rss_mb()
    for _ in range(10):
        try_often(99)
    assert standing() == before
    assert peak_rss_mb() - rss_mb < 3
    logging.getLogger("streamtrack.sources").setLevel(logging.NOTSET)


# -- the parts ----------------------------------------------------------------------------------


def test_backoff_doubles_to_a_minute_with_jitter() -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_backoff, "_FIRST_S", 1.0)
        patch.setattr(_backoff, "_LONGEST_S", 60.0)
        series = [Backoff(None, seed) for seed in range(50)]
        delays = np.array([[one.next_delay_s() for _ in range(12)] for one in series], float)
    nominal = np.minimum(60, 2.0 ** np.arange(12))
    assert np.all(delays >= np.maximum(1, 0.8 * nominal) - 1e-9)
    assert np.all(delays <= np.minimum(60, 1.2 * nominal) + 1e-9)
    assert np.all(delays.std(axis=0)[1:] > 0)


def test_backoff_begins_anew_when_all_is_well() -> None:
    backoff = Backoff(3, 1)
    assert [backoff.next_delay_s() is None for _ in range(4)] == [False, False, False, True]
    backoff.reset()
    assert backoff.next_delay_s() is not None


def frame(index: int) -> Frame:
    return Frame(index, index / 30, np.zeros((2, 2), np.uint8))


def test_a_queue_gives_both_frames_after_a_hiccup_but_one_to_a_slow_reader() -> None:
    queue = FrameQueue()
    got = []
    for index in range(0, 12, 2):  # Two come while one is worked on.
        queue.put(frame(index), may_drop=True)
        queue.put(frame(index + 1), may_drop=True)
        got.append(queue.get(lambda: False))
    assert [f.index for f in got if f] == [0, 3, 5, 7, 9, 11]
    assert queue.dropped == 6
    queue = FrameQueue()
    for index in range(2):
        queue.put(frame(index), may_drop=True)
    assert [f.index for f in (queue.get(lambda: False), queue.get(lambda: False)) if f] == [0, 1]
    assert queue.dropped == 0


def test_a_frame_tells_how_long_it_or_those_dropped_for_it_waited(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now_s = 0.0
    monkeypatch.setattr(_frame_queue, "monotonic", lambda: now_s)
    queue = FrameQueue()
    late = None
    for _ in range(3):  # A reader that is always too slow, by two pictures.
        for index in range(3):
            queue.put(replace(frame(index), captured_s=0.0), may_drop=True)
            now_s += 1.0
        late = queue.get(lambda: False)
    assert late is not None and (late.index, late.waited_s) == (2, 3.0)
    queue.put(replace(frame(3), captured_s=0.0), may_drop=True)
    prompt = queue.get(lambda: False)
    assert prompt is not None and (prompt.index, prompt.waited_s) == (3, 0.0)
    queue.put(frame(0), may_drop=False)  # Files are never late.
    now_s += 1.0
    read = queue.get(lambda: False, may_drop=False)
    assert read is not None and read.waited_s == 0.0


def test_a_closed_queue_wakes_a_waiting_writer() -> None:
    queue = FrameQueue()

    def write() -> None:
        for index in range(5):
            queue.put(frame(index), may_drop=False)

    writer = threading.Thread(target=write)
    writer.start()
    assert eventually(lambda: writer.is_alive())
    queue.close()
    writer.join(2)
    assert not writer.is_alive()


def test_an_epoch_clock_takes_out_jumps_but_keeps_small_irregularities() -> None:
    clock = EpochClock()
    clock.begin_epoch()
    stream = [100.0, 100.033, 100.066, 3.0, 3.033, 3.02, 500.0]
    mono = [7.0, 7.03, 7.07, 7.1, 7.13, 7.17, 7.2]
    times = [clock.time_s(s, m) for s, m in zip(stream, mono, strict=True)]
    np.testing.assert_allclose(times, [0, 0.033, 0.066, 0.1, 0.133, 0.133, 0.2], atol=1e-5)
    assert all(b > a for a, b in pairwise(times))


def test_an_arrival_clock_sees_jitter_as_age_and_forgets_slowly(rng: np.random.Generator) -> None:
    clock = ArrivalClock()
    time_s = np.arange(3000) / 30 + 5
    captured_s = time_s + 1000.0
    delay_s = rng.exponential(0.01, len(time_s))
    delay_s[1500:1530] += np.linspace(1, 0.03, 30)  # A stop of a second, then a burst.
    arrived_s = np.maximum.accumulate(captured_s + 0.02 + delay_s)
    told = np.array([clock.captured_s(t, a) for t, a in zip(time_s, arrived_s, strict=True)])
    assert np.all(told <= arrived_s + 1e-9)
    # All but the constant part of the delay is seen, once a few have come.
    np.testing.assert_allclose(told[300:] - captured_s[300:], 0.02, atol=0.003)


def test_an_arrival_clock_follows_drift_and_jumps() -> None:
    clock = ArrivalClock()
    for n in range(30 * 600):  # Ten minutes; the camera's clock is 200 ppm slow.
        mono_s = n / 30
        told = clock.captured_s(mono_s * (1 - 200e-6), mono_s)
        assert mono_s - told < 0.025
    for jump_s in (1000.0, -900.0, -3.0):
        told = clock.captured_s(mono_s + jump_s, mono_s + 0.1)
        assert told == pytest.approx(mono_s + 0.1)


@pytest.mark.parametrize(
    ("rate", "max_fps", "expected"),
    [(30, 10, 10), (30, 30, 30), (30, 20, 20), (25, 24, 24), (5, 30, 5)],
)
def test_thinning_keeps_the_asked_rate_in_spite_of_jitter(
    rate: int, max_fps: float, expected: int, rng: np.random.Generator
) -> None:
    times = np.arange(rate * 20) / rate + rng.uniform(-0.003, 0.003, rate * 20)
    thinner, again = Thinner(max_fps), Thinner(max_fps)
    kept = [t for t in times if thinner.takes(float(t))]
    assert len(kept) == pytest.approx(expected * 20, rel=0.04)
    assert [t for t in kept if again.takes(float(t))] == kept  # It may be done twice.
