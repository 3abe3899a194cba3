"""Print the middle half of a source's picture as x,y,w,h: the demo's target when none is given."""

import sys

from streamtrack.cli import exit_on_error
from streamtrack.sources import open_source


def main() -> None:
    with open_source(sys.argv[1]) as source:
        width, height = source.info.size_wh
    sys.stdout.write(f"{width // 4},{height // 4},{width // 2},{height // 2}\n")


if __name__ == "__main__":
    exit_on_error(main)
