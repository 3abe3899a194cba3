"""streamtrack mosaic beside OpenCV's Stitcher, the `stitching` package and hugin, in one run.

    python scripts/compare_stitchers.py SET... [--reps 3] [--out FOLDER] [--stitching PYTHON]

Each SET is a folder, or pictures joined by commas. `stitching` brings an OpenCV of its own, so
it is best installed elsewhere (python -m venv peers; peers/bin/pip install stitching-headless)
and named: --stitching peers/bin/python. Hugin: apt install hugin-tools enblend.

Every peer is a fresh process that reads the pictures, joins them and writes a PNG; imports are
included. Reported are the median of user + sys CPU seconds, the peak memory, the size of the
result, and how many pictures are in it if the peer says so. What is not installed is skipped with
a word. OpenCV's Stitcher runs in both its modes.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import statistics
import subprocess
import sys
import time
from pathlib import Path

from streamtrack.sources.images import find_pictures, read_picture

_TIMEOUT_S = 600
_MEMORY_BYTES = 8_000_000_000

_OPENCV = """
import sys, cv2
mode, out, *names = sys.argv[1:]
pictures = [cv2.imread(name) for name in names]
stitcher = cv2.Stitcher_create(getattr(cv2, "Stitcher_" + mode))
status, result = stitcher.stitch(pictures)
if status != cv2.Stitcher_OK:
    raise SystemExit(f"status {status}")
cv2.imwrite(out, result)
print(len(stitcher.component()))
"""

_STITCHING = """
import sys, cv2
from stitching import Stitcher
out, *names = sys.argv[1:]
stitcher = Stitcher(crop=False)
cv2.imwrite(out, stitcher.stitch(names))
print(len(stitcher.images.names))
"""


def peers(names: list[str], out: Path, stitching: str) -> dict[str, list[list[str]] | str]:
    """Commands of each peer, run one after the other, or why it is skipped."""
    python = sys.executable
    ours = [python, "-m", "streamtrack", "mosaic", *names, "-o", str(out)]
    found: dict[str, list[list[str]] | str] = {
        "streamtrack": [[*ours, "--summary", f"{out}.json", "--quiet"]],
        "opencv PANORAMA": [[python, "-c", _OPENCV, "PANORAMA", str(out), *names]],
        "opencv SCANS": [[python, "-c", _OPENCV, "SCANS", str(out), *names]],
    }
    if subprocess.run([stitching, "-c", "import stitching"], capture_output=True).returncode:
        found["stitching"] = "skipped: not installed (pip install stitching-headless)"
    else:
        found["stitching"] = [[stitching, "-c", _STITCHING, str(out), *names]]
    tools = ("pto_gen", "cpfind", "cpclean", "autooptimiser", "pano_modify", "nona", "enblend")
    missing = [tool for tool in tools if shutil.which(tool) is None]
    if missing:
        found["hugin"] = f"skipped: {', '.join(missing)} not installed (apt install hugin-tools)"
    else:
        found["hugin"] = _hugin(names, out)
    return found


def _hugin(names: list[str], out: Path) -> list[list[str]]:
    project, layer = f"{out}.pto", f"{out}-"
    return [
        ["pto_gen", "--fov=50", "-o", project, *names],
        ["cpfind", "--multirow", "-o", project, project],
        ["cpclean", "-o", project, project],
        ["autooptimiser", "-a", "-m", "-l", "-s", "-o", project, project],
        ["pano_modify", "--canvas=AUTO", "--fov=AUTO", "-o", project, project],
        ["nona", "-m", "TIFF_m", "-o", layer, project],
        ["sh", "-c", f"enblend -o '{out}' '{layer}'*.tif"],
    ]


def _limit_memory() -> None:
    import resource

    resource.setrlimit(resource.RLIMIT_AS, (_MEMORY_BYTES, _MEMORY_BYTES))


def run(commands: list[list[str]]) -> tuple[float, float, float, str, str]:
    """CPU seconds, wall seconds, peak MB, last line of stdout, and an error or nothing."""
    cpu_s, peak_mb, said, began = 0.0, 0.0, "", time.perf_counter()
    for command in commands:
        process = subprocess.Popen(
            command,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            preexec_fn=_limit_memory,
            start_new_session=True,
        )
        assert process.stdout is not None
        text = process.stdout.read()
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        cpu_s += usage.ru_utime + usage.ru_stime
        peak_mb = max(peak_mb, usage.ru_maxrss / 1000)
        lines = [line for line in text.strip().splitlines() if ": info:" not in line]
        said = lines[-1] if lines else ""
        if process.returncode:
            return cpu_s, time.perf_counter() - began, peak_mb, said, said[:60] or "failed"
    return cpu_s, time.perf_counter() - began, peak_mb, said, ""


def used(peer: str, out: Path, said: str, count: int) -> str:
    """How many of the pictures the peer says it used."""
    if peer == "streamtrack":
        return f"{json.loads(Path(f'{out}.json').read_text())['frames']['used']}/{count}"
    return f"-/{count}" if peer == "hugin" else f"{said}/{count}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sets", nargs="+")
    parser.add_argument("--reps", type=int, default=3)
    parser.add_argument("--out", type=Path, default=Path("stitchers"))
    parser.add_argument("--stitching", default=sys.executable, help="the Python that has it")
    parser.add_argument("--only", help="peers to run, joined by commas")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    print("| set | peer | CPU s | wall s | RSS MB | result | used |\n|---|---|---|---|---|---|---|")
    for given in options.sets:
        parts = given.split(",")
        names = [str(path) for path in find_pictures(parts[0] if len(parts) == 1 else parts)]
        for peer, commands in peers(names, Path("x.png"), options.stitching).items():
            if options.only and peer.split()[0] not in options.only.split(","):
                continue
            label = f"{Path(parts[0]).name}{len(names)}"
            if isinstance(commands, str):
                print(f"| {label} | {peer} | - | - | - | {commands} | - |", flush=True)
                continue
            out = options.out / f"{label}-{peer.replace(' ', '-')}.png"
            commands = peers(names, out, options.stitching)[peer]
            assert not isinstance(commands, str)
            results = [run(commands) for _ in range(options.reps)]
            cpu, wall, rss = (statistics.median(r[i] for r in results) for i in range(3))
            error = results[-1][4]
            if error:
                result, share = error.replace("|", "/"), "-"
            else:
                picture = read_picture(out)
                result = f"{picture.shape[1]}x{picture.shape[0]}"
                share = used(peer, out, results[-1][3], len(names))
            row = f"{label} | {peer} | {cpu:.2f} | {wall:.2f} | {rss:.0f} | {result} | {share}"
            print(f"| {row} |", flush=True)


if __name__ == "__main__":
    main()
